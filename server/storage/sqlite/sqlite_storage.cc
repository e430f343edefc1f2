#include "server/storage/sqlite/sqlite_storage.h"

#include <filesystem>
#include <memory>
#include <optional>
#include <system_error>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/kept_answer.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/check_rows.h"
#include "server/storage/sqlite/pair_rows.h"
#include "server/storage/sqlite/snapshot_rows.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/sqlite_writer.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_opening.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

class SqliteStorage : public SqliteReader {
 public:
  SqliteStorage(std::string path, std::unique_ptr<SqliteWriter> writer,
                std::unique_ptr<SqliteDatabase> anchor, const std::string& vfs,
                std::int64_t min_free_bytes)
      : SqliteReader(std::move(path), std::move(anchor),
                     SqliteDatabase::Mode::kReadOnly, vfs, writer.get()),
        min_free_bytes_(min_free_bytes),
        writer_(std::move(writer)) {}

  // The writer's connection is the last that closes.
  ~SqliteStorage() override {
    writer_->End();
    CloseReaders();
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    const std::size_t bytes = record.payload.size();
    const KeptAnswer<VehicleKey> key;
    Submit(
        bytes,
        [record = std::move(record), key](SqliteDatabase& database) {
          return key.Keep(InsertVehicle(database, record));
        },
        key.Then(std::move(done)));
  }

  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override {
    const std::size_t bytes = payload.size();
    Submit(
        bytes,
        [key, payload = std::move(payload),
         revision](SqliteDatabase& database) {
          return ChangeVehicle(database, key, payload, revision);
        },
        std::move(done));
  }

  void DeleteVehicle(VehicleKey key, EventRecord farewell, Done done) override {
    const std::size_t bytes = farewell.payload.size();
    Submit(
        bytes,
        [this, key, farewell = std::move(farewell)](SqliteDatabase& database) {
          const absl::Status status = RemoveVehicle(database, key, farewell);
          if (status.ok()) writer_->PurgeSoon();
          writer_->ForgetNextSequence(key);
          return status;
        },
        std::move(done), PendingWrite::Need::kLittle);
  }

  void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::optional<std::string> vehicle_payload,
                     Done done) override {
    writer_->Append(key, std::move(batches), std::move(vehicle_payload),
                    std::move(done));
  }

  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    Submit(
        // A revision may be large.
        SqliteWriter::kAlone,
        [this, key, batches = std::move(batches),
         revision](SqliteDatabase& database) {
          writer_->PurgeSoon();
          return ReviseBatchRows(database, key, batches, revision);
        },
        std::move(done));
  }

  void ReplaceBatches(VehicleKey key, std::vector<BatchVersions> batches,
                      std::uint64_t revision, Done done) override {
    Submit(
        // It removes many rows.
        SqliteWriter::kAlone,
        [this, key, batches = std::move(batches),
         revision](SqliteDatabase& database) {
          writer_->PurgeSoon();
          return ReplaceBatchRows(database, key, batches, revision);
        },
        std::move(done));
  }

  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::optional<ChecksWrite> checks, std::uint64_t revision,
                   Done done) override {
    Submit(
        0,
        [key, kind, pair = std::move(pair), checks = std::move(checks),
         revision](SqliteDatabase& database) {
          absl::Status status =
              InsertPosePair(database, key, kind, pair, revision);
          if (!status.ok() || !checks) return status;
          return StoreChecks(database, key, *checks);
        },
        std::move(done));
  }

  void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                      std::optional<ChecksWrite> checks, std::uint64_t revision,
                      Done done) override {
    Submit(
        0,
        [key, deleted = std::move(deleted), checks = std::move(checks),
         revision](SqliteDatabase& database) {
          absl::Status status =
              RemovePosePair(database, key, deleted, revision);
          if (!status.ok() || !checks) return status;
          return StoreChecks(database, key, *checks);
        },
        std::move(done));
  }

  void PutChecks(VehicleKey key, ChecksWrite checks, Done done) override {
    std::size_t bytes = 0;
    for (const CheckRecord& check : checks.checks) {
      bytes += check.payload.size();
    }
    for (const EventRecord& event : checks.events) {
      bytes += event.payload.size();
    }
    Submit(
        bytes,
        [key, checks = std::move(checks)](SqliteDatabase& database) {
          return StoreChecks(database, key, checks);
        },
        std::move(done));
  }

  void DropEvents(std::int64_t before_ns, int most, Done done) override {
    Submit(
        0,
        [before_ns, most](SqliteDatabase& database) {
          return DropOldEvents(database, before_ns, most);
        },
        std::move(done), PendingWrite::Need::kLittle);
  }

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    const std::size_t bytes = payload.size();
    Submit(
        bytes,
        [this, key, last_sequence, payload = std::move(payload),
         revision](SqliteDatabase& database) {
          writer_->ForgetNextSequence(key);
          writer_->PurgeSoon();
          return DropDamagedRows(database, key, last_sequence, payload,
                                 revision);
        },
        std::move(done));
  }

  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override {
    const std::size_t bytes = part.size();
    Submit(
        bytes,
        [this, key, number, part = std::move(part)](SqliteDatabase& database) {
          if (number == 0) writer_->PurgeSoon();
          return PutSnapshotPartRow(database, key, number, part);
        },
        std::move(done));
  }

  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                   Done done) override {
    const std::size_t bytes = snapshot.payload.size();
    Submit(
        bytes,
        [key, snapshot = std::move(snapshot)](SqliteDatabase& database) {
          return PutSnapshotRow(database, key, snapshot);
        },
        std::move(done));
  }

  void DropSnapshot(VehicleKey key, Done done) override {
    Submit(
        0,
        [this, key](SqliteDatabase& database) {
          writer_->PurgeSoon();
          return DropSnapshotRow(database, key);
        },
        std::move(done), PendingWrite::Need::kLittle);
  }

  void PutMarks(VehicleKey key, std::string marks, Done done) override {
    const std::size_t bytes = marks.size();
    Submit(
        bytes,
        [key, marks = std::move(marks)](SqliteDatabase& database) {
          return PutMarksRow(database, key, marks);
        },
        std::move(done));
  }

  absl::Status CheckWritable() override {
    return writer_->HasRoom() ? absl::OkStatus()
                              : StorageFull("the disk of the store is full");
  }

  CommitCounts Counts() const override { return writer_->Counts(); }

  std::optional<StorageRoom> GetRoom() const override {
    std::optional<StorageRoom> room = SqliteReader::GetRoom();
    if (room) room->min_free_bytes = min_free_bytes_;
    return room;
  }

 private:
  void Submit(std::size_t bytes, SqliteWriter::Change change, Done done,
              PendingWrite::Need need = PendingWrite::Need::kRoom) {
    writer_->Submit(bytes, std::move(change), std::move(done), need);
  }

  const std::int64_t min_free_bytes_;
  const std::unique_ptr<SqliteWriter> writer_;
};

// The canonical path, because two names of one file must find the same lock.
std::string Canonical(const std::string& path) {
  std::error_code error;
  const std::filesystem::path canonical =
      std::filesystem::weakly_canonical(std::filesystem::path(path), error);
  return error ? path : canonical.string();
}

}  // namespace

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorage(
    const std::string& path, const SqliteOptions& options) {
  const std::string store = Canonical(path);
  const std::uint64_t run = RandomRun();
  absl::Status status = CheckDatabaseIsThere(store);
  if (absl::IsNotFound(status)) status = MakeStore(store, options.vfs, run);
  if (!status.ok()) return status;
  absl::StatusOr<std::unique_ptr<StoreLock>> lock = StoreLock::Acquire(store);
  if (!lock.ok()) return lock.status();
  absl::StatusOr<std::unique_ptr<DurableMark>> mark = DurableMark::Open(store);
  if (!mark.ok()) return mark.status();
  status = CheckStoreFiles(store, options.drop_damaged_log, options.warn,
                           mark->get());
  if (!status.ok()) return status;
  absl::StatusOr<OpenedWriter> writer =
      OpenWriter(store, options.vfs, run, mark->get(), /*copies_log=*/true);
  const bool gave_up_reserve =
      IsStorageFull(writer.status()) && GiveUpReserve(store);
  if (gave_up_reserve) {
    writer = OpenWriter(store, options.vfs, run, mark->get(),
                        /*copies_log=*/true);
  }
  if (!writer.ok()) return writer.status();
  // The log may never have been flushed: the server before may have been
  // killed, or its device may have failed, just then. From here on its commits
  // count as durable, so they are made durable: in the database, or in the log.
  if (!writer->is_copied) status = FlushAnew(LogOf(store));
  if (!status.ok()) return status;
  if (options.drop_damaged_log) {
    // Without this, dropped commits could be back after a power failure.
    status = FlushFile(LogOf(store));
    if (!status.ok()) return status;
  }
  // An old store needs this too: the server that made it may have been killed
  // before it came to this.
  status =
      FlushDirectories(std::filesystem::path(store).parent_path().string());
  if (!status.ok()) return status;
  // The lock may hold a later state if a log was dropped.
  (*lock)->Write(writer->state);
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenAnchor(store, options.vfs);
  if (!anchor.ok()) return anchor.status();
  status = CheckFile(**anchor, store, options.max_checked_bytes);
  if (!status.ok()) return status;
  if (!gave_up_reserve) KeepReserve(store);
  return std::unique_ptr<Storage>(new SqliteStorage(
      store,
      std::make_unique<SqliteWriter>(store, options, run, *std::move(lock),
                                     *std::move(mark), *std::move(writer)),
      *std::move(anchor), options.vfs, options.min_free_bytes));
}

}  // namespace revisit::server
