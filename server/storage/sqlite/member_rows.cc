#include "server/storage/sqlite/member_rows.h"

#include <algorithm>

#include "server/storage/group_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {

namespace {

absl::Status WriteMember(SqliteDatabase& database, const std::string& group_id,
                         const GroupMemberRecord& member) {
  return database
      .Prepare(
          "INSERT OR REPLACE INTO group_members (group_id, vehicle_key, "
          "format, "
          "checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5)")
      .BindText(1, group_id)
      .Bind(2, member.vehicle)
      .Bind(3, kStoreFormat)
      .Bind(4, ChecksumOfMember(kStoreFormat, group_id, member))
      .BindBlob(5, member.payload)
      .Run();
}

}  // namespace

absl::Status CheckIsMember(SqliteDatabase& database,
                           const std::string& group_id, VehicleKey vehicle) {
  SqliteStatement row = database.Prepare(
      "SELECT 1 FROM group_members WHERE group_id = ?1 AND vehicle_key = ?2");
  const absl::StatusOr<bool> found =
      row.BindText(1, group_id).Bind(2, vehicle).Step();
  if (!found.ok()) return found.status();
  return *found ? absl::OkStatus() : NoSuchMember(group_id, vehicle);
}

absl::Status InsertMember(SqliteDatabase& database, const std::string& group_id,
                          const GroupMemberRecord& member) {
  const absl::Status vehicle = VehicleId(database, member.vehicle).status();
  if (!vehicle.ok()) return vehicle;
  const absl::Status is_member =
      CheckIsMember(database, group_id, member.vehicle);
  if (is_member.ok()) return MemberExists(group_id, member.vehicle);
  if (!absl::IsNotFound(is_member)) return is_member;
  return WriteMember(database, group_id, member);
}

absl::Status ReplaceMember(SqliteDatabase& database,
                           const std::string& group_id,
                           const GroupMemberRecord& member) {
  const absl::Status is_member =
      CheckIsMember(database, group_id, member.vehicle);
  if (!is_member.ok()) return is_member;
  return WriteMember(database, group_id, member);
}

absl::Status RemoveMemberRow(SqliteDatabase& database,
                             const std::string& group_id, VehicleKey vehicle) {
  const absl::Status status =
      database
          .Prepare(
              "DELETE FROM group_members WHERE group_id = ?1 AND vehicle_key = "
              "?2")
          .BindText(1, group_id)
          .Bind(2, vehicle)
          .Run();
  if (!status.ok() || database.Changes() > 0) return status;
  return NoSuchMember(group_id, vehicle);
}

absl::Status RemoveAllMembers(SqliteDatabase& database,
                              const std::string& group_id) {
  return database.Prepare("DELETE FROM group_members WHERE group_id = ?1")
      .BindText(1, group_id)
      .Run();
}

absl::StatusOr<std::vector<GroupMemberRecord>> FindMembers(
    SqliteDatabase& database, const std::string& group_id,
    const std::string& after_vehicle_id, int limit) {
  std::vector<GroupMemberRecord> members;
  SqliteStatement row = database.Prepare(
      "SELECT m.vehicle_key, v.id, m.format, m.checksum, m.payload FROM "
      "group_members AS m JOIN vehicles AS v ON v.key = m.vehicle_key WHERE "
      "m.group_id = ?1 AND v.id > ?2 ORDER BY v.id LIMIT ?3");
  row.BindText(1, group_id).BindText(2, after_vehicle_id);
  row.Bind(3, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return members;
    GroupMemberRecord& member = members.emplace_back();
    member.vehicle = row.Integer(0);
    member.vehicle_id = row.Bytes(1);
    member.payload = row.Bytes(4);
    CheckMemberRow(row.Integer(2), row.Integer(3), group_id, &member);
  }
}

absl::StatusOr<std::vector<std::string>> FindGroupIdsOf(
    SqliteDatabase& database, VehicleKey vehicle) {
  std::vector<std::string> ids;
  SqliteStatement row = database.Prepare(
      "SELECT group_id FROM group_members WHERE vehicle_key = ?1 ORDER BY "
      "group_id");
  row.Bind(1, vehicle);
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return ids;
    ids.push_back(row.Bytes(0));
  }
}

}  // namespace revisit::server
