// The rows of a store: every statement that reads or writes them, with their
// checks. Which tables there are is said in sqlite_storage.h, how they were
// made in store_opening.cc.
//
// All of it runs within the transaction, if any, of the connection it is given.
// What is read has passed its checksum, or is DATA_LOSS (STORE_CORRUPT), or a
// record that says so of itself. The other errors are those of the calls of
// Storage (storage.h) that these are for.
#ifndef REVISIT_SERVER_STORAGE_STORE_ROWS_H_
#define REVISIT_SERVER_STORAGE_STORE_ROWS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/storage.h"

namespace revisit::server {

// ---- Vehicles

// The id of a vehicle, not checked: to tell whether it is there, and for
// messages.
absl::StatusOr<std::string> VehicleId(SqliteDatabase& database, VehicleKey key);

absl::StatusOr<VehicleRecord> FindVehicle(SqliteDatabase& database,
                                          const std::string& id);
// As Storage::ListVehicles().
absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    SqliteDatabase& database, const std::string& after_id,
    const std::string& prefix, int limit);

absl::StatusOr<VehicleKey> InsertVehicle(SqliteDatabase& database,
                                         VehicleRecord record);
// Replaces the payload, if given, and raises the revision.
absl::Status ChangeVehicle(SqliteDatabase& database, VehicleKey key,
                           const std::optional<std::string>& payload,
                           std::uint64_t revision);
// As Storage::DropDamaged().
absl::Status DropDamagedRows(SqliteDatabase& database, VehicleKey key,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision);
// Its batches stay, out of reach, until PurgeSome() has removed them.
absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key);

// Removes some rows of deleted vehicles, with so many batches at most; answers
// whether more may be left.
absl::StatusOr<bool> PurgeSome(SqliteDatabase& database, int batches);

// Gives pages that no row uses back to the file system, as far as there are
// more than `kept` and not more than `most` at a time, since others are moved
// to their places; answers how many. None in a file that was made by a server
// of format 1 or 2 and not compacted since.
absl::StatusOr<std::int64_t> GiveBackPages(SqliteDatabase& database,
                                           std::int64_t kept,
                                           std::int64_t most);
// Makes that possible in the file that this one is vacuumed into.
absl::Status SetShrinking(SqliteDatabase& database);

// ---- Batches

// `expected` is the sequence that comes next, where it is known: then it is not
// read; else 0. It is set to the one after the batch.
absl::Status InsertBatch(SqliteDatabase& database, VehicleKey key,
                         const BatchRecord& batch, std::uint64_t* expected);
absl::Status ReviseBatchRows(SqliteDatabase& database, VehicleKey key,
                             const BatchSource& batches,
                             std::uint64_t revision);
// As Storage::ReadBatches(); of one moment if the connection is in a
// transaction.
absl::Status VisitBatches(SqliteDatabase& database, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit);

// ---- Pairs of poses

absl::Status InsertPosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision);
absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision);
// As Storage::ListPosePairs().
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    SqliteDatabase& database, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_ROWS_H_
