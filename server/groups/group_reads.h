// Reads of all that belongs to a group, some rows at a time. They block on the
// storage.
#ifndef REVISIT_SERVER_GROUPS_GROUP_READS_H_
#define REVISIT_SERVER_GROUPS_GROUP_READS_H_

#include <functional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_storage.h"

namespace revisit::server {

// Call `visit` with each member, ordered by the vehicle's id, or each link,
// ordered by id, damaged ones too, until it returns false. Not as of one
// moment.
absl::Status VisitMembers(GroupStorage* groups, const std::string& group_id,
                          const std::function<bool(GroupMemberRecord&)>& visit);
absl::Status VisitLinks(GroupStorage* groups, const std::string& group_id,
                        const std::function<bool(GroupLinkRecord&)>& visit);

// The member with this vehicle, which may be damaged; NOT_FOUND
// (MEMBER_NOT_FOUND) if there is none.
absl::StatusOr<GroupMemberRecord> FindMember(GroupStorage* groups,
                                             const std::string& group_id,
                                             const std::string& vehicle_id);

// NOT_FOUND (MEMBER_NOT_FOUND). The words do not give away whether the caller
// may not know of the vehicle.
absl::Status VehicleIsNoMember(const std::string& group_id,
                               const std::string& vehicle_id);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_GROUP_READS_H_
