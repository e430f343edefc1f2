// The statements that read records, which needs no claim; those of checks and
// events are in postgres_checks.h. The tables are those
// of migrations.h; errors are those of the calls of Storage (storage.h) that
// use these functions, and of connection.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READS_H_

#include <cstdint>
#include <functional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/records.h"

namespace revisit::server {

// The vehicle's id, printable; NOT_FOUND if there is no such vehicle.
absl::StatusOr<std::string> VehicleId(PostgresConnection& connection,
                                      VehicleKey key);
absl::StatusOr<VehicleRecord> FindVehicle(PostgresConnection& connection,
                                          const std::string& id);
// Implements Storage::GetVehicles().
absl::StatusOr<std::vector<VehicleRecord>> FindVehiclesOf(
    PostgresConnection& connection, const std::set<std::string>& ids);
absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit);
// Implements Storage::ListVehicleRows().
absl::StatusOr<std::vector<VehicleRecord>> FindVehicleRows(
    PostgresConnection& connection, VehicleKey after_key, int limit);
absl::Status VisitBatches(PostgresConnection& connection, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit);
absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    PostgresConnection& connection, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit);
// Implements Storage::ListDeletedPairs().
absl::StatusOr<std::vector<DeletedPairRecord>> FindDeletedPairs(
    PostgresConnection& connection, VehicleKey key);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READS_H_
