// The edits that add to a group what its contract allows
// (proto/revisit/v1/group.proto). They block on the storage.
#ifndef REVISIT_SERVER_GROUPS_GROUP_EDITS_H_
#define REVISIT_SERVER_GROUPS_GROUP_EDITS_H_

#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/groups/group_editor.h"
#include "server/groups/new_link.h"
#include "server/sessions/record_codec.h"
#include "server/storage/group_records.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Most members and links of a group.
struct GroupLimits {
  std::size_t members = 1000;
  std::size_t links = 10000;
};

// No changes if the member is there with this payload; ALREADY_EXISTS
// (MEMBER_EXISTS) if it has another one, FAILED_PRECONDITION (GROUP_LIMIT).
absl::StatusOr<GroupEdit> EditToAddMember(GroupStorage* groups,
                                          const GroupRecord& group,
                                          const GroupMemberRecord& member,
                                          const GroupLimits& limits);

// `link` becomes the one that the group has, or has with the edit: later than
// all others, and not before `now_ns`. No changes if the group has a link of
// this id that says the same. Errors: VEHICLE_NOT_FOUND; INVALID_ARGUMENT if
// the vehicles have two state spaces, or the measurement does not fit theirs;
// MEMBER_NOT_FOUND unless both are members; ALREADY_EXISTS
// (LOOP_CLOSURE_EXISTS or REJECTED_CANDIDATE_EXISTS); FAILED_PRECONDITION
// (POSE_PAIR_CONFLICT) if the poses are a link of the other kind, and
// (GROUP_LIMIT), which counts both kinds; and those of CheckPoseIsStored().
//
// A pose that its vehicle's owner drops at this very moment may come to be
// linked: the owner looks at the links before it drops poses (pose_dropper.h),
// a link is added after its poses were looked at, and no server holds the other
// up, for which each link would have to lock the rows of two vehicles. Such a
// link ties nothing (server/fleet/joined_group.h).
absl::StatusOr<GroupEdit> EditToAddLink(
    Storage* storage, const RecordCodec& codec, const GroupRecord& group,
    const NewLink& wanted, std::int64_t now_ns, const GroupLimits& limits,
    GroupLinkRecord* link);

// The edit that removes the link of this kind and id, which the caller knows.
GroupEdit EditToRemoveLink(PairKind kind, const std::string& id);
// The error of an edit that removes one, as its caller is told it: NOT_FOUND
// (LOOP_CLOSURE_NOT_FOUND or REJECTED_CANDIDATE_NOT_FOUND) where there is none.
absl::Status RemovalError(PairKind kind, const std::string& id,
                          const absl::Status& error);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_GROUP_EDITS_H_
