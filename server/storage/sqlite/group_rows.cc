#include "server/storage/sqlite/group_rows.h"

#include <algorithm>
#include <set>
#include <utility>
#include <variant>

#include "server/storage/group_check.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/link_rows.h"
#include "server/storage/sqlite/member_rows.h"

namespace revisit::server {
namespace {

// The columns are id, format, revision, uid, checksum, payload.
GroupRecord ReadGroupRow(const SqliteStatement& row) {
  GroupRecord group;
  group.id = row.Bytes(0);
  group.version = {row.Bytes(3), Unsigned(row.Integer(2))};
  group.payload = row.Bytes(5);
  CheckGroupRow(row.Integer(1), row.Integer(4), &group);
  return group;
}

absl::Status RaiseRevision(SqliteDatabase& database, const std::string& id) {
  return database
      .Prepare(
          "UPDATE vehicle_groups SET revision = revision + 1 WHERE id = ?1")
      .BindText(1, id)
      .Run();
}

// The changes of a group, but for its revision.
struct Changer {
  absl::Status operator()(const SetGroupPayload& change) const {
    // A damaged row that is written again would pass for sound.
    if (!group.damage.ok()) return group.damage;
    GroupRecord changed = group;
    changed.payload = change.payload;
    return database
        .Prepare(
            "UPDATE vehicle_groups SET format = ?2, checksum = ?3, payload = "
            "?4 WHERE id = ?1")
        .BindText(1, changed.id)
        .Bind(2, kStoreFormat)
        .Bind(3, ChecksumOfGroup(kStoreFormat, changed))
        .BindBlob(4, changed.payload)
        .Run();
  }
  absl::Status operator()(const AddGroupMember& change) const {
    return InsertMember(database, group.id, change.member);
  }
  absl::Status operator()(const SetGroupMember& change) const {
    return ReplaceMember(database, group.id, change.member);
  }
  absl::Status operator()(const RemoveGroupMember& change) const {
    const absl::Status status =
        RemoveMemberRow(database, group.id, change.vehicle);
    if (!status.ok()) return status;
    return RemoveLinksOf(database, group.id, change.vehicle);
  }
  absl::Status operator()(const AddGroupLink& change) const {
    return InsertLink(database, group.id, change.link);
  }
  absl::Status operator()(const SetGroupLink& change) const {
    return ReplaceLink(database, group.id, change);
  }
  absl::Status operator()(const RemoveGroupLink& change) const {
    return RemoveLink(database, group.id, change.id);
  }

  SqliteDatabase& database;
  const GroupRecord& group;
};

// The group, if it is as expected.
absl::StatusOr<GroupRecord> FindExpected(
    SqliteDatabase& database, const std::string& id,
    const std::optional<GroupVersion>& expected) {
  absl::StatusOr<GroupRecord> group = FindGroup(database, id);
  if (!group.ok()) return group;
  absl::Status status = CheckVersion(*group, expected);
  if (!status.ok()) return status;
  return group;
}

}  // namespace

absl::Status InsertGroup(SqliteDatabase& database, const GroupRecord& group) {
  const absl::Status before = FindGroup(database, group.id).status();
  if (before.ok()) return GroupExists(group.id);
  if (!absl::IsNotFound(before)) return before;
  return database
      .Prepare(
          "INSERT INTO vehicle_groups (id, format, revision, uid, checksum, "
          "payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6)")
      .BindText(1, group.id)
      .Bind(2, kStoreFormat)
      .Bind(3, Signed(group.version.revision))
      .BindText(4, group.version.uid)
      .Bind(5, ChecksumOfGroup(kStoreFormat, group))
      .BindBlob(6, group.payload)
      .Run();
}

absl::StatusOr<std::uint64_t> ChangeGroupRows(
    SqliteDatabase& database, const std::string& id,
    const std::optional<GroupVersion>& expected,
    const std::vector<GroupChange>& changes) {
  const absl::StatusOr<GroupRecord> group =
      FindExpected(database, id, expected);
  if (!group.ok()) return group.status();
  for (const GroupChange& change : changes) {
    const absl::Status status = std::visit(Changer{database, *group}, change);
    if (!status.ok()) return status;
  }
  const absl::Status status = RaiseRevision(database, id);
  if (!status.ok()) return status;
  return group->version.revision + 1;
}

absl::StatusOr<std::uint64_t> RemoveGroup(
    SqliteDatabase& database, const std::string& id,
    const std::optional<GroupVersion>& expected) {
  const absl::StatusOr<GroupRecord> group =
      FindExpected(database, id, expected);
  if (!group.ok()) return group.status();
  absl::Status status = RemoveAllLinks(database, id);
  if (status.ok()) status = RemoveAllMembers(database, id);
  if (status.ok()) {
    status = database.Prepare("DELETE FROM vehicle_groups WHERE id = ?1")
                 .BindText(1, id)
                 .Run();
  }
  if (!status.ok()) return status;
  return group->version.revision + 1;
}

absl::Status LeaveGroups(SqliteDatabase& database, VehicleKey vehicle) {
  const absl::StatusOr<std::vector<std::string>> groups =
      FindGroupIdsOf(database, vehicle);
  if (!groups.ok()) return groups.status();
  for (const std::string& id : *groups) {
    absl::Status status = RemoveLinksOf(database, id, vehicle);
    if (status.ok()) status = RemoveMemberRow(database, id, vehicle);
    if (status.ok()) status = RaiseRevision(database, id);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::Status CutLinks(SqliteDatabase& database, VehicleKey vehicle,
                      std::uint64_t last_sequence) {
  const absl::StatusOr<std::vector<std::string>> groups =
      RemoveLinksAfter(database, vehicle, last_sequence);
  if (!groups.ok()) return groups.status();
  for (const std::string& id : *groups) {
    const absl::Status status = RaiseRevision(database, id);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::StatusOr<GroupRecord> FindGroup(SqliteDatabase& database,
                                      const std::string& id) {
  SqliteStatement row = database.Prepare(
      "SELECT id, format, revision, uid, checksum, payload FROM vehicle_groups "
      "WHERE id = ?1");
  const absl::StatusOr<bool> found = row.BindText(1, id).Step();
  if (!found.ok()) return found.status();
  if (!*found) return NoSuchGroup(id);
  return ReadGroupRow(row);
}

absl::StatusOr<std::vector<GroupRecord>> FindGroups(SqliteDatabase& database,
                                                    const std::string& after_id,
                                                    const std::string& prefix,
                                                    int limit) {
  std::vector<GroupRecord> groups;
  const std::string beyond = BeyondPrefix(prefix);
  SqliteStatement row = database.Prepare(
      "SELECT id, format, revision, uid, checksum, payload FROM vehicle_groups "
      "WHERE id > ?1 AND id >= ?2 AND id < ?3 ORDER BY id LIMIT ?4");
  row.BindText(1, after_id).BindText(2, prefix).BindText(3, beyond);
  row.Bind(4, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return groups;
    groups.push_back(ReadGroupRow(row));
  }
}

absl::StatusOr<std::vector<GroupRecord>> FindGroupVersions(
    SqliteDatabase& database,
    const std::optional<std::vector<std::string>>& ids) {
  std::vector<GroupRecord> groups;
  const auto read = [&](SqliteStatement& row) -> absl::Status {
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found) return absl::OkStatus();
      GroupRecord& group = groups.emplace_back();
      group.id = row.Bytes(0);
      group.version = {row.Bytes(1), Unsigned(row.Integer(2))};
    }
  };
  if (!ids) {
    SqliteStatement all = database.Prepare(
        "SELECT id, uid, revision FROM vehicle_groups ORDER BY id");
    const absl::Status status = read(all);
    if (!status.ok()) return status;
    return groups;
  }
  for (const std::string& id :
       std::set<std::string>(ids->begin(), ids->end())) {
    SqliteStatement one = database.Prepare(
        "SELECT id, uid, revision FROM vehicle_groups WHERE id = ?1");
    one.BindText(1, id);
    const absl::Status status = read(one);
    if (!status.ok()) return status;
  }
  return groups;
}

}  // namespace revisit::server
