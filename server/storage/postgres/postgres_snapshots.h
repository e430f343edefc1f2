// The statements that write and read snapshots, in tables of version 2
// (migrations.h). Each write is one statement, and fenced, as in
// postgres_changes.h. Nothing here removes a snapshot because poses change: the
// tables do, so that servers of the version before cannot forget to.
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
#include "server/storage/storage.h"

namespace revisit::server {

// ---- Writes

absl::Status PutSnapshotPartRow(PostgresConnection& connection,
                                const Fence& fence, std::uint32_t number,
                                const std::string& part);
absl::Status PutSnapshotRow(PostgresConnection& connection, const Fence& fence,
                            const SnapshotRecord& snapshot);
absl::Status DropSnapshotRow(PostgresConnection& connection,
                             const Fence& fence);

// Removes some parts of snapshots that are gone; returns whether more may be
// left.
absl::StatusOr<bool> PurgeSnapshots(PostgresConnection& connection);

// ---- Reads

absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    PostgresConnection& connection, VehicleKey key);
absl::Status VisitSnapshotParts(
    PostgresConnection& connection, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_SNAPSHOTS_H_
