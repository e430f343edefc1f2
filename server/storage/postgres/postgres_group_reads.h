// The statements that read groups, their members and links (migrations.h).
// Tables of the version before have no room for them: there are none. Errors
// are those of GroupStorage (group_storage.h) and of connection.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_READS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_READS_H_

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/postgres/connection.h"

namespace revisit::server {

absl::StatusOr<bool> KeepsGroups(PostgresConnection& connection);
// FAILED_PRECONDITION (STORE_UNAVAILABLE) unless there is room for groups.
absl::Status CheckKeepsGroups(PostgresConnection& connection);

// The group, whose row is held until the transaction ends. REQUIRES, as
// FindLink(): there is room for groups.
absl::StatusOr<GroupRecord> HoldGroup(PostgresConnection& connection,
                                      const std::string& id);
// NOT_FOUND (LOOP_CLOSURE_NOT_FOUND).
absl::StatusOr<GroupLinkRecord> FindLink(PostgresConnection& connection,
                                         const std::string& group_id,
                                         const std::string& id);

// These implement the calls of GroupStorage.
absl::StatusOr<GroupRecord> FindGroup(PostgresConnection& connection,
                                      const std::string& id);
absl::StatusOr<std::vector<GroupRecord>> FindGroups(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit);
absl::StatusOr<std::vector<GroupRecord>> FindGroupVersions(
    PostgresConnection& connection,
    const std::optional<std::vector<std::string>>& ids);
absl::StatusOr<std::vector<GroupMemberRecord>> FindMembers(
    PostgresConnection& connection, const std::string& group_id,
    const std::string& after_vehicle_id, int limit);
absl::StatusOr<std::vector<std::string>> FindGroupsOf(
    PostgresConnection& connection, VehicleKey vehicle);
absl::StatusOr<std::vector<GroupLinkRecord>> FindLinks(
    PostgresConnection& connection, const std::string& group_id,
    const std::string& after_id, int limit);
absl::StatusOr<std::vector<PlacedLink>> FindLinksOf(
    PostgresConnection& connection, VehicleKey vehicle, const LinkPlace& after,
    int limit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_GROUP_READS_H_
