// The rows of `check_heads`, `checks`, `events` and `dropped_events`; see
// vehicle_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_CHECK_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_CHECK_ROWS_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// The default head where the vehicle has none. DATA_LOSS (STORE_CORRUPT) if it
// is damaged.
absl::StatusOr<ChecksHead> FindChecksHead(SqliteDatabase& database,
                                          VehicleKey key);
// Implements Storage::PutChecks().
absl::Status StoreChecks(SqliteDatabase& database, VehicleKey key,
                         const ChecksWrite& write);
// Adds checks of a vehicle that is imported, and sets its head.
absl::Status ImportChecks(SqliteDatabase& database, VehicleKey key,
                          const ChecksHead& head,
                          const std::vector<CheckRecord>& checks);
// Removes the checks of poses after `last_sequence`, and damaged ones, and sets
// the head back to it; a damaged head is made anew from what there is.
absl::Status DropDamagedChecks(SqliteDatabase& database, VehicleKey key,
                               std::uint64_t last_sequence);
// Removes all checks of a vehicle, and the payloads of its events; adds
// `farewell` behind them, if there are any.
absl::Status RemoveChecks(SqliteDatabase& database, VehicleKey key,
                          EventRecord farewell);
// Implements Storage::ListChecks().
absl::StatusOr<std::vector<CheckRecord>> FindChecks(
    SqliteDatabase& database, VehicleKey key, std::uint64_t first_sequence,
    std::uint64_t last_sequence, bool open_only, int limit);
// Implements Storage::ListUnchecked().
absl::StatusOr<std::vector<VehicleRecord>> FindUnchecked(
    SqliteDatabase& database, VehicleKey after_key, int limit);
// Implements Storage::ReadEvents().
absl::StatusOr<std::vector<EventRecord>> FindEvents(SqliteDatabase& database,
                                                    const EventPosition& after,
                                                    int limit);
// Implements Storage::LastEvent().
absl::StatusOr<EventPosition> FindLastEvent(SqliteDatabase& database);
// Implements Storage::DropEvents().
absl::Status DropOldEvents(SqliteDatabase& database, std::int64_t before_ns,
                           int most);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_CHECK_ROWS_H_
