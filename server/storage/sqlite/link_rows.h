// The rows of `group_links`; see vehicle_rows.h and group_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_LINK_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_LINK_ROWS_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// The errors are those of AddGroupLink, and so on.
absl::Status InsertLink(SqliteDatabase& database, const std::string& group_id,
                        const GroupLinkRecord& link);
absl::Status ReplaceLink(SqliteDatabase& database, const std::string& group_id,
                         const SetGroupLink& change);
absl::Status RemoveLink(SqliteDatabase& database, const std::string& group_id,
                        const std::string& id);
// Removes those of which an end is at the vehicle.
absl::Status RemoveLinksOf(SqliteDatabase& database,
                           const std::string& group_id, VehicleKey vehicle);
absl::Status RemoveAllLinks(SqliteDatabase& database,
                            const std::string& group_id);
// Removes those that name a pose of the vehicle after `last_sequence`; returns
// the ids of the groups that have lost any.
absl::StatusOr<std::vector<std::string>> RemoveLinksAfter(
    SqliteDatabase& database, VehicleKey vehicle, std::uint64_t last_sequence);
// Implements GroupStorage::ListLinks() for a group that is there.
absl::StatusOr<std::vector<GroupLinkRecord>> FindLinks(
    SqliteDatabase& database, const std::string& group_id,
    const std::string& after_id, int limit);
// Implements GroupStorage::ListLinksOf().
absl::StatusOr<std::vector<PlacedLink>> FindLinksOf(SqliteDatabase& database,
                                                    VehicleKey vehicle,
                                                    const LinkPlace& after,
                                                    int limit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_LINK_ROWS_H_
