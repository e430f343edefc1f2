#include "server/groups/group_reads.h"

#include <utility>

#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr int kRowsAtATime = 1000;

// `list` reads the rows behind a place, `place_of` is that of a row.
template <typename Row, typename List, typename PlaceOf>
absl::Status VisitRows(const List& list, const PlaceOf& place_of,
                       const std::function<bool(Row&)>& visit) {
  std::string after;
  while (true) {
    absl::StatusOr<std::vector<Row>> rows = list(after);
    if (!rows.ok()) return rows.status();
    if (!rows->empty()) after = place_of(rows->back());
    for (Row& row : *rows) {
      if (!visit(row)) return absl::OkStatus();
    }
    if (rows->size() < kRowsAtATime) return absl::OkStatus();
  }
}

}  // namespace

absl::Status VisitMembers(
    GroupStorage* groups, const std::string& group_id,
    const std::function<bool(GroupMemberRecord&)>& visit) {
  return VisitRows<GroupMemberRecord>(
      [&](const std::string& after) {
        return groups->ListMembers(group_id, after, kRowsAtATime);
      },
      [](const GroupMemberRecord& member) { return member.vehicle_id; }, visit);
}

absl::Status VisitLinks(GroupStorage* groups, const std::string& group_id,
                        const std::function<bool(GroupLinkRecord&)>& visit) {
  return VisitRows<GroupLinkRecord>(
      [&](const std::string& after) {
        return groups->ListLinks(group_id, after, kRowsAtATime);
      },
      [](const GroupLinkRecord& link) { return link.id; }, visit);
}

absl::StatusOr<GroupMemberRecord> FindMember(GroupStorage* groups,
                                             const std::string& group_id,
                                             const std::string& vehicle_id) {
  absl::StatusOr<GroupMemberRecord> found =
      VehicleIsNoMember(group_id, vehicle_id);
  const absl::Status status =
      VisitMembers(groups, group_id, [&](GroupMemberRecord& member) {
        if (member.vehicle_id != vehicle_id) return true;
        found = std::move(member);
        return false;
      });
  if (!status.ok()) return status;
  return found;
}

absl::Status VehicleIsNoMember(const std::string& group_id,
                               const std::string& vehicle_id) {
  return Error(
      absl::StatusCode::kNotFound, "MEMBER_NOT_FOUND",
      "vehicle '" + vehicle_id + "' is no member of group '" + group_id + "'");
}

}  // namespace revisit::server
