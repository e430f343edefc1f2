// The rows of a store: every statement that reads or writes them, with their
// checks. sqlite_storage.h lists the tables, store_opening.cc makes them.
//
// All functions run within the transaction, if any, of the given connection.
// Rows that they return have passed their checksum; others are DATA_LOSS
// (STORE_CORRUPT), or a record with `damage` set. Other errors are those of the
// calls of Storage (storage.h) that use these functions.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_ROWS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/storage.h"

namespace revisit::server {

// ---- Vehicles

// The id of a vehicle, without a check of its row: to see whether the vehicle
// exists, and for messages.
absl::StatusOr<std::string> VehicleId(SqliteDatabase& database, VehicleKey key);

absl::StatusOr<VehicleRecord> FindVehicle(SqliteDatabase& database,
                                          const std::string& id);
// Implements Storage::ListVehicles().
absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    SqliteDatabase& database, const std::string& after_id,
    const std::string& prefix, int limit);

absl::StatusOr<VehicleKey> InsertVehicle(SqliteDatabase& database,
                                         VehicleRecord record);
// Inserts a vehicle under the key that it has.
absl::Status ImportVehicle(SqliteDatabase& database,
                           const VehicleRecord& record);
// Replaces the payload, if given, and raises the revision.
absl::Status ChangeVehicle(SqliteDatabase& database, VehicleKey key,
                           const std::optional<std::string>& payload,
                           std::uint64_t revision);
// Implements Storage::DropDamaged().
absl::Status DropDamagedRows(SqliteDatabase& database, VehicleKey key,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision);
// Removes a vehicle. Its batches stay, out of reach, until PurgeSome() has
// removed them.
absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key);

// Removes some rows of deleted vehicles and of deleted snapshots, with at most
// `batches` batches, or as many bytes of parts; returns whether more may be
// left.
absl::StatusOr<bool> PurgeSome(SqliteDatabase& database, int batches);

// Gives pages that no row uses back to the file system: those beyond `kept`,
// and at most `most` at a time, because other pages are moved to their places.
// Returns how many. Gives back none in a file that a server of format 1 or 2
// made and that was not compacted since.
absl::StatusOr<std::int64_t> GiveBackPages(SqliteDatabase& database,
                                           std::int64_t kept,
                                           std::int64_t most);
// Makes GiveBackPages() work in the file into which this one is vacuumed.
absl::Status SetShrinking(SqliteDatabase& database);

// ---- Batches

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

// ---- Pairs of poses

absl::Status InsertPosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision);
absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision);
// Implements Storage::ListPosePairs().
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    SqliteDatabase& database, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);

// ---- Snapshots

// These implement the calls of Storage of the same names. Parts of a snapshot
// that is removed stay, out of reach, until PurgeSome() has removed them.
absl::Status PutSnapshotPartRow(SqliteDatabase& database, VehicleKey key,
                                std::uint32_t number, const std::string& part);
absl::Status PutSnapshotRow(SqliteDatabase& database, VehicleKey key,
                            const SnapshotRecord& snapshot);
absl::Status DropSnapshotRow(SqliteDatabase& database, VehicleKey key);
absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    SqliteDatabase& database, VehicleKey key);
absl::Status VisitSnapshotParts(
    SqliteDatabase& database, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_ROWS_H_
