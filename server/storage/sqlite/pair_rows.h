// The rows of `loop_closures`, `rejected_candidates` and `deleted_pose_pairs`;
// see vehicle_rows.h.
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
// Implements Storage::DeletePosePair().
absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            DeletedPairRecord deleted, std::uint64_t revision);
// Inserts a row with the record's own number.
absl::Status InsertDeletedPair(SqliteDatabase& database, VehicleKey key,
                               const DeletedPairRecord& deleted);
// Removes all pairs of a vehicle, and those that were deleted.
absl::Status RemovePosePairs(SqliteDatabase& database, VehicleKey key);
// Removes the pairs of poses after `last_sequence`, and damaged ones, deleted
// ones too.
absl::Status RemoveDamagedPosePairs(SqliteDatabase& database, VehicleKey key,
                                    std::uint64_t last_sequence);
// Implements Storage::ListPosePairs().
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    SqliteDatabase& database, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);
// Implements Storage::ListDeletedPairs().
absl::StatusOr<std::vector<DeletedPairRecord>> FindDeletedPairs(
    SqliteDatabase& database, VehicleKey key);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_PAIR_ROWS_H_
