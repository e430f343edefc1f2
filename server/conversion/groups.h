// Groups, their members and the loop closures between these.
#ifndef REVISIT_SERVER_CONVERSION_GROUPS_H_
#define REVISIT_SERVER_CONVERSION_GROUPS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "google/protobuf/field_mask.pb.h"
#include "revisit/v1/group.pb.h"
#include "server/groups/new_link.h"
#include "server/records/group_content.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/group_records.h"

namespace revisit::server {

// ---- Groups

// The content of a group that is to be created, without creation time.
absl::StatusOr<GroupContent> DecodeGroup(const v1::Group& group);

// The content with what the mask names replaced.
absl::StatusOr<GroupContent> UpdateGroupContent(
    const GroupContent& current, const v1::Group& group,
    const google::protobuf::FieldMask& update_mask);

// Encodes what the row holds; of a damaged one name, uid and revision, with the
// damage as the answer.
absl::Status EncodeGroup(const GroupRecord& record, v1::Group* group);

// Leaves in an answer which group it is, as callers may know who changed it but
// may not read it, and what they themselves have set.
void TrimToSettings(v1::Group* group);
void TrimToMask(const google::protobuf::FieldMask& mask, v1::Group* group);

// ---- Members

// The payload of the member that a request has at `member`, by the settings of
// its vehicle.
absl::StatusOr<std::string> DecodeMember(const v1::GroupMember& member,
                                         const VehicleConfig& vehicle);

// DATA_LOSS if the row is damaged.
absl::Status EncodeMember(const std::string& group_id,
                          const GroupMemberRecord& record,
                          v1::GroupMember* member);

// ---- Loop closures and rejected candidates

// An id that was left out is made from vehicles and sequences. `decided_by` is
// the caller's identity: that of the message is not read.
absl::StatusOr<NewLink> DecodeLink(
    const v1::AddInterVehicleLoopClosureRequest& request,
    const std::string& decided_by);
absl::StatusOr<NewLink> DecodeLink(
    const v1::RejectInterVehicleCandidateRequest& request,
    const std::string& decided_by);

// The vehicles' ids are those of the record's ends. DATA_LOSS if the row is
// damaged. REQUIRES: the record is of the message's kind.
absl::Status EncodeLink(const std::string& group_id,
                        const std::string& query_vehicle,
                        const std::string& matched_vehicle,
                        const GroupLinkRecord& record,
                        v1::InterVehicleLoopClosure* closure);
absl::Status EncodeLink(const std::string& group_id,
                        const std::string& query_vehicle,
                        const std::string& matched_vehicle,
                        const GroupLinkRecord& record,
                        v1::InterVehicleRejectedCandidate* rejection);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_GROUPS_H_
