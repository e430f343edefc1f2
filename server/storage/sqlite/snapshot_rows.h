// The rows of `snapshots`, `snapshot_parts` and `deleted_snapshots`; see
// vehicle_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SNAPSHOT_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SNAPSHOT_ROWS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// Removes the snapshot of a vehicle, if there is one. Its parts stay, out of
// reach, until PurgeSnapshots() has removed them.
absl::Status ForgetSnapshot(SqliteDatabase& database, VehicleKey key);

// These implement the calls of Storage of the same names.
absl::Status PutSnapshotPartRow(SqliteDatabase& database, VehicleKey key,
                                std::uint32_t number, const std::string& part);
absl::Status PutSnapshotRow(SqliteDatabase& database, VehicleKey key,
                            const SnapshotRecord& snapshot);
absl::Status DropSnapshotRow(SqliteDatabase& database, VehicleKey key);
absl::Status PutMarksRow(SqliteDatabase& database, VehicleKey key,
                         const std::string& marks);
absl::StatusOr<std::optional<std::string>> FindMarks(SqliteDatabase& database,
                                                     VehicleKey key);
absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    SqliteDatabase& database, VehicleKey key);
absl::Status VisitSnapshotParts(
    SqliteDatabase& database, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit);

// Removes at most `parts` parts of removed snapshots; returns whether more may
// be left.
absl::StatusOr<bool> PurgeSnapshots(SqliteDatabase& database, int parts);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SNAPSHOT_ROWS_H_
