#include "server/storage/postgres/postgres_reader.h"

#include <optional>
#include <utility>

#include "server/base/status.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/postgres/postgres_reads.h"
#include "server/storage/postgres/postgres_snapshots.h"

namespace revisit::server {
namespace {

class ReadOnlyPostgres : public PostgresReader {
 public:
  explicit ReadOnlyPostgres(PostgresDatabase database)
      : PostgresReader(std::move(database)) {}

  void CreateVehicle(
      VehicleRecord,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    done(ReadOnly());
  }
  void UpdateVehicle(VehicleKey, std::string, std::uint64_t,
                     Done done) override {
    done(ReadOnly());
  }
  void DeleteVehicle(VehicleKey, Done done) override { done(ReadOnly()); }
  void AppendBatches(VehicleKey, std::vector<BatchRecord>,
                     std::optional<std::string>, Done done) override {
    done(ReadOnly());
  }
  void ReviseBatches(VehicleKey, BatchSource, std::uint64_t,
                     Done done) override {
    done(ReadOnly());
  }
  void ReplaceBatches(VehicleKey, std::vector<BatchVersions>, std::uint64_t,
                      Done done) override {
    done(ReadOnly());
  }
  void AddPosePair(VehicleKey, PairKind, PosePairRecord, std::uint64_t,
                   Done done) override {
    done(ReadOnly());
  }
  void DeletePosePair(VehicleKey, PairKind, std::string, std::uint64_t,
                      Done done) override {
    done(ReadOnly());
  }
  void DropDamaged(VehicleKey, std::uint64_t, std::string, std::uint64_t,
                   Done done) override {
    done(ReadOnly());
  }
  void PutSnapshotPart(VehicleKey, std::uint32_t, std::string,
                       Done done) override {
    done(ReadOnly());
  }
  void PutSnapshot(VehicleKey, SnapshotRecord, Done done) override {
    done(ReadOnly());
  }
  void DropSnapshot(VehicleKey, Done done) override { done(ReadOnly()); }

  absl::StatusOr<std::vector<StorageUser>> ListUsers() override {
    return Read<std::vector<StorageUser>>(ListLivingServers);
  }

 private:
  static absl::Status ReadOnly() {
    return Error(absl::StatusCode::kFailedPrecondition, "INTERNAL",
                 "this store was opened for reading");
  }
};

}  // namespace

absl::StatusOr<PostgresDatabase> LookAtDatabase(const std::string& conninfo) {
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  const auto connection = PostgresConnection::Open(options);
  if (!connection.ok()) return connection.status();
  const absl::StatusOr<int> version = CheckSchema(**connection);
  if (!version.ok()) return version.status();
  return PostgresDatabase{conninfo, *version, (*connection)->durability()};
}

PostgresReader::PostgresReader(PostgresDatabase database)
    : database_(std::move(database)), connections_(database_.conninfo, {}) {}

absl::StatusOr<VehicleRecord> PostgresReader::GetVehicle(
    const std::string& id) {
  return Read<VehicleRecord>([&](PostgresConnection& connection) {
    return FindVehicle(connection, id);
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

absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorageToRead(
    const std::string& conninfo) {
  absl::StatusOr<PostgresDatabase> database = LookAtDatabase(conninfo);
  if (!database.ok()) return database.status();
  return std::unique_ptr<Storage>(new ReadOnlyPostgres(*std::move(database)));
}

}  // namespace revisit::server
