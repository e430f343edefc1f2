// The statements that write and read snapshots (migrations.h). Each write is
// one statement, and fenced, as in postgres_changes.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_SNAPSHOTS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_SNAPSHOTS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_fence.h"
#include "server/storage/records.h"

namespace revisit::server {

// ---- SQL

// A part of a write behind its fence: forgets the snapshot of the vehicle whose
// key is in `h`, and leaves what to purge. The snapshot's key is in `d`.
#define REVISIT_FORGET_SNAPSHOT                                             \
  ", d AS (DELETE FROM snapshots t USING h WHERE t.vehicle_key = h.key "    \
  "RETURNING t.key), e AS (INSERT INTO deleted_snapshots (key) SELECT key " \
  "FROM d) "

// ---- Writes

absl::Status PutSnapshotPartRow(PostgresConnection& connection,
                                const Fence& fence, std::uint32_t number,
                                const std::string& part);
absl::Status PutSnapshotRow(PostgresConnection& connection, const Fence& fence,
                            const SnapshotRecord& snapshot);
absl::Status DropSnapshotRow(PostgresConnection& connection,
                             const Fence& fence);
absl::Status PutMarksRow(PostgresConnection& connection, const Fence& fence,
                         const std::string& marks);

// Forgets the snapshot within a transaction that changes the poses which it
// comes from, and that holds the vehicle's head.
absl::Status ForgetSnapshot(PostgresConnection& connection, VehicleKey key);

// Removes some parts of snapshots that are gone; returns whether more may be
// left.
absl::StatusOr<bool> PurgeSnapshots(PostgresConnection& connection);

// ---- Reads

absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    PostgresConnection& connection, VehicleKey key);
absl::StatusOr<std::optional<std::string>> FindMarks(
    PostgresConnection& connection, VehicleKey key);
absl::Status VisitSnapshotParts(
    PostgresConnection& connection, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_SNAPSHOTS_H_
