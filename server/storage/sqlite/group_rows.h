// The rows of `vehicle_groups`, and the changes that a group's rows in all
// tables have in common (member_rows.h, link_rows.h); see vehicle_rows.h. Each
// change raises the revisions of the groups that it concerns.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_GROUP_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_GROUP_ROWS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// Inserts a group with the revision that the record has. ALREADY_EXISTS
// (GROUP_EXISTS).
absl::Status InsertGroup(SqliteDatabase& database, const GroupRecord& group);
// Implements GroupStorage::ChangeGroup(); returns the new revision.
absl::StatusOr<std::uint64_t> ChangeGroupRows(
    SqliteDatabase& database, const std::string& id,
    const std::optional<GroupVersion>& expected,
    const std::vector<GroupChange>& changes);
// Implements GroupStorage::DeleteGroup().
absl::StatusOr<std::uint64_t> RemoveGroup(
    SqliteDatabase& database, const std::string& id,
    const std::optional<GroupVersion>& expected);
// Removes a vehicle from its groups, with its links.
absl::Status LeaveGroups(SqliteDatabase& database, VehicleKey vehicle);
// Removes the links that name a pose of the vehicle after `last_sequence`.
absl::Status CutLinks(SqliteDatabase& database, VehicleKey vehicle,
                      std::uint64_t last_sequence);

absl::StatusOr<GroupRecord> FindGroup(SqliteDatabase& database,
                                      const std::string& id);
// Implements GroupStorage::ListGroups().
absl::StatusOr<std::vector<GroupRecord>> FindGroups(SqliteDatabase& database,
                                                    const std::string& after_id,
                                                    const std::string& prefix,
                                                    int limit);
// Implements GroupStorage::ListGroupVersions().
absl::StatusOr<std::vector<GroupRecord>> FindGroupVersions(
    SqliteDatabase& database,
    const std::optional<std::vector<std::string>>& ids);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_GROUP_ROWS_H_
