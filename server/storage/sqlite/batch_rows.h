// The rows of `batches` and `revised_batches`; see vehicle_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_BATCH_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_BATCH_ROWS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// The last batch as sent, if there is one. Messages name the vehicle.
absl::StatusOr<std::optional<BatchRecord>> ReadLastBatch(
    SqliteDatabase& database, VehicleKey key, const std::string& vehicle_id);
// Sequence at which the last batch ends according to its row, damaged or not;
// 0 if there is none.
absl::StatusOr<std::uint64_t> ClaimedSequence(SqliteDatabase& database,
                                              VehicleKey key);

// `expected` is the sequence that comes next if it is known, which saves
// reading it, or 0. It is set to the sequence after the batch.
absl::Status InsertBatch(SqliteDatabase& database, VehicleKey key,
                         const BatchRecord& batch, std::uint64_t* expected);
absl::Status ReviseBatchRows(SqliteDatabase& database, VehicleKey key,
                             const BatchSource& batches,
                             std::uint64_t revision);
absl::Status ReplaceBatchRows(SqliteDatabase& database, VehicleKey key,
                              const std::vector<BatchVersions>& batches,
                              std::uint64_t revision);
// Implements Storage::ReadBatches(); as of one moment if the connection is in a
// transaction.
absl::Status VisitBatches(SqliteDatabase& database, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_BATCH_ROWS_H_
