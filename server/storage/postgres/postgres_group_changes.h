// The statements that write groups, their members and links (migrations.h).
// Groups have no owner: each write is a transaction that holds the group's row,
// so that writes of a group come one after the other, and each statement of it
// sees what those before have left.
//
// Rows are locked in one order, so that none of these waits in a circle: a
// vehicle, then groups by id, then what belongs to them. A write that adds a
// member locks the vehicle before the group; the triggers of migrations.h, by
// which a vehicle leaves its groups, lock these by id once the vehicle's row is
// theirs.
//
// Errors are those of GroupStorage (group_storage.h) and of connection.h, and
// FAILED_PRECONDITION (STORE_UNAVAILABLE) with tables of the version before,
// which have no room for groups.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_CHANGES_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_CHANGES_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/postgres/connection.h"

namespace revisit::server {

// Inserts a group with the revision that the record has, and returns it.
absl::StatusOr<std::uint64_t> InsertGroup(PostgresConnection& connection,
                                          const GroupRecord& group);
// Implements GroupStorage::ChangeGroup(); returns the new revision.
absl::StatusOr<std::uint64_t> ChangeGroupRows(
    PostgresConnection& connection, const std::string& id,
    const std::optional<GroupVersion>& expected,
    const std::vector<GroupChange>& changes);
// Implements GroupStorage::DeleteGroup().
absl::StatusOr<std::uint64_t> RemoveGroup(
    PostgresConnection& connection, const std::string& id,
    const std::optional<GroupVersion>& expected);

// Rows of a group that is imported.
absl::Status InsertMemberRow(PostgresConnection& connection,
                             const std::string& group_id,
                             const GroupMemberRecord& member);
absl::Status InsertLinkRow(PostgresConnection& connection,
                           const std::string& group_id,
                           const GroupLinkRecord& link);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_CHANGES_H_
