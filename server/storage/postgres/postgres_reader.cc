#include "server/storage/postgres/postgres_reader.h"

#include <optional>
#include <utility>

#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/postgres/postgres_checks.h"
#include "server/storage/postgres/postgres_reads.h"
#include "server/storage/postgres/postgres_snapshots.h"
#include "server/storage/read_only_storage.h"

namespace revisit::server {

absl::StatusOr<PostgresDatabase> LookAtDatabase(const std::string& conninfo) {
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  const auto connection = PostgresConnection::Open(options);
  if (!connection.ok()) return connection.status();
  const absl::Status known = CheckSchema(**connection);
  if (!known.ok()) return known;
  return PostgresDatabase{conninfo, (*connection)->durability()};
}

PostgresReader::PostgresReader(PostgresDatabase database,
                               PostgresWriter* group_writer)
    : database_(std::move(database)),
      connections_(database_.conninfo, {}),
      groups_(&connections_, group_writer) {}

absl::StatusOr<VehicleRecord> PostgresReader::GetVehicle(
    const std::string& id) {
  return Read<VehicleRecord>([&](PostgresConnection& connection) {
    return FindVehicle(connection, id);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> PostgresReader::GetVehicles(
    const std::set<std::string>& ids) {
  return Read<std::vector<VehicleRecord>>([&](PostgresConnection& connection) {
    return FindVehiclesOf(connection, ids);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> PostgresReader::ListVehicles(
    const std::string& after_id, const std::string& prefix, int limit) {
  return Read<std::vector<VehicleRecord>>([&](PostgresConnection& connection) {
    return FindVehicles(connection, after_id, prefix, limit);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> PostgresReader::ListVehicleRows(
    VehicleKey after_key, int limit) {
  return Read<std::vector<VehicleRecord>>([&](PostgresConnection& connection) {
    return FindVehicleRows(connection, after_key, limit);
  });
}

absl::Status PostgresReader::ReadBatches(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    BatchVersion version, const std::function<bool(BatchRecord)>& visit) {
  return connections_.Use([&](PostgresConnection& connection) {
    return VisitBatches(connection, key, first_sequence, last_sequence, version,
                        visit);
  });
}

absl::StatusOr<std::vector<PosePairRecord>> PostgresReader::ListPosePairs(
    VehicleKey key, PairKind kind, const std::string& after_id, int limit) {
  return Read<std::vector<PosePairRecord>>([&](PostgresConnection& connection) {
    return FindPosePairs(connection, key, kind, after_id, limit);
  });
}

absl::StatusOr<std::vector<DeletedPairRecord>> PostgresReader::ListDeletedPairs(
    VehicleKey key) {
  return Read<std::vector<DeletedPairRecord>>(
      [&](PostgresConnection& connection) {
        return FindDeletedPairs(connection, key);
      });
}

absl::StatusOr<std::vector<CheckRecord>> PostgresReader::ListChecks(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    bool open_only, int limit) {
  return Read<std::vector<CheckRecord>>([&](PostgresConnection& connection) {
    return FindChecks(connection, key, first_sequence, last_sequence, open_only,
                      limit);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> PostgresReader::ListUnchecked(
    VehicleKey after_key, int limit) {
  return Read<std::vector<VehicleRecord>>([&](PostgresConnection& connection) {
    return FindUnchecked(connection, Self(), after_key, limit);
  });
}

absl::StatusOr<std::vector<EventRecord>> PostgresReader::ReadEvents(
    const EventPosition& after, int limit) {
  return Read<std::vector<EventRecord>>([&](PostgresConnection& connection) {
    return FindEvents(connection, after, limit);
  });
}

absl::StatusOr<EventPosition> PostgresReader::LastEvent() {
  return Read<EventPosition>(FindLastEvent);
}

absl::StatusOr<std::optional<SnapshotRecord>> PostgresReader::GetSnapshot(
    VehicleKey key) {
  using Found = std::optional<SnapshotRecord>;
  return Read<Found>([&](PostgresConnection& connection) {
    return FindSnapshot(connection, key);
  });
}

absl::Status PostgresReader::ReadSnapshotParts(
    VehicleKey key, std::uint32_t first, std::uint32_t end,
    const std::function<bool(absl::string_view)>& visit) {
  return connections_.Use([&](PostgresConnection& connection) {
    return VisitSnapshotParts(connection, key, first, end, visit);
  });
}

absl::StatusOr<std::optional<std::string>> PostgresReader::GetMarks(
    VehicleKey key) {
  using Found = std::optional<std::string>;
  return Read<Found>([&](PostgresConnection& connection) {
    return FindMarks(connection, key);
  });
}

absl::StatusOr<std::vector<StorageUser>> PostgresReader::ListUsers() {
  return Read<std::vector<StorageUser>>(ListLivingServers);
}

absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorageToRead(
    const std::string& conninfo) {
  absl::StatusOr<PostgresDatabase> database = LookAtDatabase(conninfo);
  if (!database.ok()) return database.status();
  return std::unique_ptr<Storage>(
      new ReadOnlyStorage<PostgresReader>(*std::move(database)));
}

}  // namespace revisit::server
