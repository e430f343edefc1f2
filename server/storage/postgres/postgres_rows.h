// Every statement that reads or writes records in PostgreSQL. The tables are
// those of migrations.h.
//
// A write is one statement, which commits by itself (ReviseBatchRows()
// excepted, which may be too large), so that a server that is stopped in the
// middle of it holds nothing. It compares owner and epoch of the vehicle's
// head, and writes nothing where they differ: ABORTED (EPOCH_FENCED). Other
// errors are those of the calls of Storage (storage.h) that use these
// functions, and of connection.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_ROWS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_ROWS_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/storage.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

// ---- Reads

absl::StatusOr<VehicleRecord> FindVehicle(PostgresConnection& connection,
                                          const std::string& id);
absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit);
absl::Status VisitBatches(PostgresConnection& connection, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit);
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    PostgresConnection& connection, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);

// ---- Writes

// A vehicle and the claim under which it is written; null if there was none.
struct Fence {
  VehicleKey key = 0;
  std::shared_ptr<const Claim> claim;
};

absl::StatusOr<VehicleKey> InsertVehicle(PostgresConnection& connection,
                                         VehicleRecord record);
absl::Status ChangeVehicle(PostgresConnection& connection, const Fence& fence,
                           const std::string& payload, std::uint64_t revision);
absl::Status RemoveVehicle(PostgresConnection& connection, const Fence& fence);

// Rows of one vehicle that follow each other, submitted under one claim.
using AppendRun = std::vector<const PendingWrite*>;

// Appends runs, at most one per vehicle, in one statement. OK if the statement
// was run: then `results` has the outcome of each run, which is written whole
// or not at all. Otherwise nothing was written, or the connection is in doubt.
absl::Status AppendRuns(PostgresConnection& connection,
                        const std::vector<AppendRun>& runs,
                        std::vector<absl::Status>* results);
absl::Status AppendWithVehicle(PostgresConnection& connection,
                               const Fence& fence, const BatchRecord& batch,
                               const std::string& vehicle_payload);
absl::Status ReviseBatchRows(PostgresConnection& connection, const Fence& fence,
                             const BatchSource& batches,
                             std::uint64_t revision);
absl::Status DropDamagedRows(PostgresConnection& connection, const Fence& fence,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision);

absl::Status InsertPosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision);
absl::Status RemovePosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision);

// Removes some batches of deleted vehicles; returns whether more may be left.
absl::StatusOr<bool> PurgeSome(PostgresConnection& connection);

// The append's statement, for tests of its plan.
const char* AppendSql();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_ROWS_H_
