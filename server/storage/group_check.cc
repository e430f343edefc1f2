#include "server/storage/group_check.h"

#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {

using absl::StatusCode;

absl::Status GroupExists(const std::string& id) {
  return Error(StatusCode::kAlreadyExists, "GROUP_EXISTS",
               "group '" + id + "' exists already");
}

absl::Status NoSuchGroup(const std::string& id) {
  return Error(StatusCode::kNotFound, "GROUP_NOT_FOUND",
               "no such group: '" + id + "'");
}

absl::Status MemberExists(const std::string& group_id, VehicleKey vehicle) {
  return Error(StatusCode::kAlreadyExists, "MEMBER_EXISTS",
               "the vehicle of key " + std::to_string(vehicle) +
                   " is a member of group '" + group_id + "' already");
}

absl::Status NoSuchMember(const std::string& group_id, VehicleKey vehicle) {
  return Error(StatusCode::kNotFound, "MEMBER_NOT_FOUND",
               "the vehicle of key " + std::to_string(vehicle) +
                   " is no member of group '" + group_id + "'");
}

absl::Status LinkExists(const std::string& id) {
  return PairExists(PairKind::kLoopClosure, id);
}

absl::Status NoSuchLink(const std::string& id) {
  return NoSuchPair(PairKind::kLoopClosure, id);
}

absl::Status CheckVersion(const GroupRecord& group,
                          const std::optional<GroupVersion>& expected) {
  if (!expected || *expected == group.version) return absl::OkStatus();
  const std::string revision = std::to_string(group.version.revision);
  return Error(StatusCode::kAborted, "REVISION_MISMATCH",
               "group '" + group.id + "' is at revision " + revision +
                   (group.version.uid == expected->uid ? "" : ", made anew") +
                   ", not at " + std::to_string(expected->revision),
               {{"revision", revision}});
}

void CheckGroupRow(std::int64_t format, std::int64_t checksum,
                   GroupRecord* group) {
  group->damage = CheckRow(format, checksum, ChecksumOfGroup(format, *group),
                           "stored group '" + Printable(group->id) + "'",
                           {{"group", Printable(group->id)}});
  if (!group->damage.ok()) group->payload.clear();
}

void CheckMemberRow(std::int64_t format, std::int64_t checksum,
                    const std::string& group_id, GroupMemberRecord* member) {
  const std::string vehicle = Printable(member->vehicle_id);
  member->damage = CheckRow(
      format, checksum, ChecksumOfMember(format, group_id, *member),
      "stored member '" + vehicle + "' of group '" + Printable(group_id) + "'",
      {{"group", Printable(group_id)}, {"vehicle", vehicle}});
  if (!member->damage.ok()) member->payload.clear();
}

void CheckLinkRow(std::int64_t format, std::int64_t checksum,
                  const std::string& group_id, std::int64_t state,
                  GroupLinkRecord* link) {
  link->state = LinkState::kConfirmed;
  for (const LinkState known :
       {LinkState::kTentative, LinkState::kSuspect, LinkState::kRejected}) {
    if (state == NumberOf(known)) link->state = known;
  }
  const std::string what = "stored link '" + Printable(link->id) +
                           "' of group '" + Printable(group_id) + "'";
  link->damage =
      state == NumberOf(link->state)
          ? CheckRow(format, checksum, ChecksumOfLink(format, group_id, *link),
                     what, {{"group", Printable(group_id)}})
          : Corrupt(what + " is in no state", {{"group", Printable(group_id)}});
  if (!link->damage.ok()) {
    *link = {std::move(link->id), {}, {}, {}, {}, std::move(link->damage)};
  }
}

}  // namespace revisit::server
