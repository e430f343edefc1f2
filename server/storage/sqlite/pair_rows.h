// The rows of `loop_closures` and `rejected_candidates`; see vehicle_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_PAIR_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_PAIR_ROWS_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

absl::StatusOr<std::int64_t> CountPosePairs(SqliteDatabase& database,
                                            VehicleKey key, PairKind kind);

absl::Status InsertPosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision);
absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision);
// Removes all pairs of a vehicle.
absl::Status RemovePosePairs(SqliteDatabase& database, VehicleKey key);
// Removes the pairs of poses after `last_sequence`, and damaged ones.
absl::Status RemoveDamagedPosePairs(SqliteDatabase& database, VehicleKey key,
                                    std::uint64_t last_sequence);
// Implements Storage::ListPosePairs().
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    SqliteDatabase& database, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_PAIR_ROWS_H_
