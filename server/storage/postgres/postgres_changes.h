// The statements that write anything but appends (postgres_appends.h), and
// checks and snapshots that go alone (postgres_checks.h, postgres_snapshots.h).
// A write is one statement, which commits by itself (ReviseBatchRows()
// excepted, which may be too large), so that a server that is stopped in the
// middle of it holds nothing. It compares owner, epoch and revision of the
// vehicle's head, and writes nothing where they differ: ABORTED (EPOCH_FENCED).
// Other errors are those of the calls of Storage (storage.h) that use these
// functions, and of connection.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHANGES_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHANGES_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_fence.h"
#include "server/storage/records.h"

namespace revisit::server {

// The key is above `above`, the highest that this server has known: a database
// that lacks its last commits may give keys a second time, and what is still in
// memory of the first vehicle would be written to the second.
absl::StatusOr<VehicleKey> InsertVehicle(PostgresConnection& connection,
                                         VehicleRecord record,
                                         VehicleKey above);
absl::Status ChangeVehicle(PostgresConnection& connection, const Fence& fence,
                           const std::string& payload, std::uint64_t revision);
// Implements Storage::DeleteVehicle().
absl::Status RemoveVehicle(PostgresConnection& connection, const Fence& fence,
                           EventRecord farewell);

absl::Status ReviseBatchRows(PostgresConnection& connection, const Fence& fence,
                             const BatchSource& batches,
                             std::uint64_t revision);
absl::Status ReplaceBatchRows(PostgresConnection& connection,
                              const Fence& fence,
                              const std::vector<BatchVersions>& batches,
                              std::uint64_t revision);
absl::Status DropDamagedRows(PostgresConnection& connection, const Fence& fence,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision);

absl::Status InsertPosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const PosePairRecord& pair,
                            const std::optional<ChecksWrite>& checks,
                            std::uint64_t revision);
// Implements Storage::DeletePosePair().
absl::Status RemovePosePair(PostgresConnection& connection, const Fence& fence,
                            DeletedPairRecord deleted,
                            const std::optional<ChecksWrite>& checks,
                            std::uint64_t revision);

// Implements Storage::ConfirmOwned().
absl::Status ConfirmHead(PostgresConnection& connection, const Fence& fence);

// Removes some batches of deleted vehicles; returns whether more may be left.
absl::StatusOr<bool> PurgeSome(PostgresConnection& connection);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHANGES_H_
