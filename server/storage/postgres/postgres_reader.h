// The part of a storage in PostgreSQL that needs no owner: its reads, over
// connections of their own.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READER_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READER_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/connection_pool.h"
#include "server/storage/postgres/postgres_groups.h"
#include "server/storage/storage.h"

namespace revisit::server {

// A database whose tables are known here, as it was found.
struct PostgresDatabase {
  std::string conninfo;
  Durability durability;
};
// Errors are those of OpenPostgresStorage().
absl::StatusOr<PostgresDatabase> LookAtDatabase(const std::string& conninfo);

// Thread-safe.
class PostgresReader : public Storage {
 public:
  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override;
  absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) override;
  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override;
  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override;
  absl::StatusOr<std::vector<DeletedPairRecord>> ListDeletedPairs(
      VehicleKey key) override;
  absl::StatusOr<std::vector<CheckRecord>> ListChecks(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      bool open_only, int limit) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListUnchecked(VehicleKey after_key,
                                                           int limit) override;
  absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) override;
  absl::StatusOr<EventPosition> LastEvent() override;
  GroupStorage& Groups() override { return groups_; }
  bool KeepsSnapshots() const override { return true; }
  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override;
  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override;
  absl::StatusOr<std::optional<std::string>> GetMarks(VehicleKey key) override;
  // Asks the database.
  absl::StatusOr<std::vector<StorageUser>> ListUsers() override;

 protected:
  // The server that reads, among those that share the database; none by
  // default.
  virtual Uuid Self() const { return {}; }

  // `group_writer`, which outlives all calls, is that of groups; null where
  // nothing is written.
  explicit PostgresReader(PostgresDatabase database,
                          PostgresWriter* group_writer = nullptr);

  const PostgresDatabase& database() const { return database_; }

  // Runs `read` on one of the connections.
  template <typename T>
  absl::StatusOr<T> Read(
      const std::function<absl::StatusOr<T>(PostgresConnection&)>& read) {
    return connections_.Answer<T>(read);
  }

 private:
  const PostgresDatabase database_;
  ConnectionPool connections_;
  PostgresGroups groups_;
};

// Opens the storage for reading, without joining the servers. Writes are
// FAILED_PRECONDITION. Errors are those of OpenPostgresStorage().
absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorageToRead(
    const std::string& conninfo);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_READER_H_
