#include "server/storage/postgres/postgres_reader.h"

#include <optional>
#include <utility>

#include "server/base/status.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/postgres/postgres_reads.h"

namespace revisit::server {
namespace {

// Connections that stay open while nobody reads.
constexpr std::size_t kIdleReaders = 4;

class ReadOnlyPostgres : public PostgresReader {
 public:
  explicit ReadOnlyPostgres(const std::string& conninfo)
      : PostgresReader(conninfo) {}

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
  void AppendBatch(VehicleKey, BatchRecord, std::optional<std::string>,
                   Done done) override {
    done(ReadOnly());
  }
  void ReviseBatches(VehicleKey, BatchSource, std::uint64_t,
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

 private:
  static absl::Status ReadOnly() {
    return Error(absl::StatusCode::kFailedPrecondition, "INTERNAL",
                 "this store was opened for reading");
  }
};

}  // namespace

absl::StatusOr<std::unique_ptr<PostgresConnection>> LookAtDatabase(
    const std::string& conninfo) {
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  auto connection = PostgresConnection::Open(options);
  if (!connection.ok()) return connection.status();
  if (absl::Status status = CheckSchema(**connection); !status.ok()) {
    return status;
  }
  return connection;
}

PostgresReader::PostgresReader(const std::string& conninfo)
    : connections_(conninfo, kIdleReaders) {}

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

absl::StatusOr<std::vector<StorageUser>> PostgresReader::ListUsers() {
  return Read<std::vector<StorageUser>>(Ownership::ListUsers);
}

absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorageToRead(
    const std::string& conninfo) {
  const auto connection = LookAtDatabase(conninfo);
  if (!connection.ok()) return connection.status();
  return std::unique_ptr<Storage>(new ReadOnlyPostgres(conninfo));
}

}  // namespace revisit::server
