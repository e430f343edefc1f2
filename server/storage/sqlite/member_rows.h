// The rows of `group_members`; see vehicle_rows.h and group_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_MEMBER_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_MEMBER_ROWS_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// OK if the vehicle is a member.
absl::Status CheckIsMember(SqliteDatabase& database,
                           const std::string& group_id, VehicleKey vehicle);
// The errors are those of AddGroupMember.
absl::Status InsertMember(SqliteDatabase& database, const std::string& group_id,
                          const GroupMemberRecord& member);
absl::Status ReplaceMember(SqliteDatabase& database,
                           const std::string& group_id,
                           const GroupMemberRecord& member);
// Removes the row alone, without the member's links.
absl::Status RemoveMemberRow(SqliteDatabase& database,
                             const std::string& group_id, VehicleKey vehicle);
absl::Status RemoveAllMembers(SqliteDatabase& database,
                              const std::string& group_id);
// Implements GroupStorage::ListMembers() for a group that is there.
absl::StatusOr<std::vector<GroupMemberRecord>> FindMembers(
    SqliteDatabase& database, const std::string& group_id,
    const std::string& after_vehicle_id, int limit);
// The ids of the groups of a vehicle, in order.
absl::StatusOr<std::vector<std::string>> FindGroupIdsOf(
    SqliteDatabase& database, VehicleKey vehicle);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_MEMBER_ROWS_H_
