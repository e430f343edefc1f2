// The part of a storage in a SQLite file that writes nothing: its reads, over
// connections of their own.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_READER_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_READER_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/sqlite/reader_pool.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/sqlite_groups.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Thread-safe.
class SqliteReader : public Storage {
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
  bool KeepsSnapshots() const override { return true; }
  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override;
  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override;
  absl::StatusOr<std::optional<std::string>> GetMarks(VehicleKey key) override;
  std::optional<StorageRoom> GetRoom() const override;
  GroupStorage& Groups() override { return groups_; }

 protected:
  // `anchor` is a connection that reads. It keeps the log's index in shared
  // memory while a writer is opened anew: otherwise it would be made from the
  // log, including failed transactions. `writer`, which outlives all calls, is
  // that of groups; null where nothing is written.
  SqliteReader(std::string path, std::unique_ptr<SqliteDatabase> anchor,
               SqliteDatabase::Mode mode, const std::string& vfs,
               SqliteWriter* writer = nullptr)
      : path_(std::move(path)),
        anchor_(std::move(anchor)),
        readers_(path_, mode, vfs),
        groups_(&readers_, writer) {}

  // Closes all connections, for a writer whose own is to be the last that
  // closes. REQUIRES: nothing is read any more.
  void CloseReaders() {
    readers_.CloseAll();
    anchor_.reset();
  }

 private:
  // Runs `read` on one of the connections.
  template <typename T>
  absl::StatusOr<T> Read(
      const std::function<absl::StatusOr<T>(SqliteDatabase&)>& read) {
    return readers_.Answer<T>(read);
  }

  const std::string path_;
  std::unique_ptr<SqliteDatabase> anchor_;
  ReaderPool readers_;
  SqliteGroups groups_;
};

// Opens a store of this format for reading, in a mode that only reads;
// kReadOnly also while a server has it open. Writes are FAILED_PRECONDITION.
// Errors are those of OpenSqliteStorage().
absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorageToRead(
    const std::string& path, SqliteDatabase::Mode mode);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_READER_H_
