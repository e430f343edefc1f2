#include "server/storage/sqlite_storage.h"

#include <pthread.h>

#include <atomic>
#include <chrono>
#include <cstdio>
#include <deque>
#include <filesystem>
#include <system_error>
#include <thread>
#include <unordered_map>
#include <utility>

#include "server/mutex.h"
#include "server/status.h"
#include "server/storage/durable_mark.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/store_files.h"
#include "server/storage/store_lock.h"
#include "server/storage/store_opening.h"
#include "server/storage/store_rows.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// Read-only connections that are kept open while nobody uses them.
constexpr std::size_t kIdleReaders = 4;

// Vehicles of which the writer remembers the sequence that comes next.
constexpr std::size_t kMaxKnownSequences = 100'000;

class SqliteStorage : public Storage {
 public:
  SqliteStorage(std::string path, const SqliteOptions& options,
                std::unique_ptr<StoreLock> lock,
                std::unique_ptr<DurableMark> mark,
                std::unique_ptr<SqliteDatabase> writer,
                std::unique_ptr<SqliteDatabase> anchor)
      : path_(std::move(path)),
        options_(options),
        lock_(std::move(lock)),
        mark_(std::move(mark)),
        space_(options.min_free_bytes,
               [file = path_] {
                 return FreeBytes(std::filesystem::path(file).parent_path());
               }),
        writer_(std::move(writer)),
        anchor_(std::move(anchor)),
        thread_([this] { Write(); }) {
    // For tools that list threads.
    pthread_setname_np(thread_.native_handle(), "store-writer");
  }

  ~SqliteStorage() override {
    {
      const MutexLock guard(&mutex_);
      stopping_ = true;
    }
    wake_.NotifyOne();
    thread_.join();
    // An orderly end leaves no log.
    if (writer_ != nullptr && mark_->Clear().ok()) {
      writer_->KeepLogOnClose(false);
    }
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    const std::size_t bytes = record.payload.size();
    auto key = std::make_shared<VehicleKey>(0);
    Submit(
        bytes,
        [record = std::move(record), key](SqliteDatabase& database) {
          const absl::StatusOr<VehicleKey> inserted =
              InsertVehicle(database, record);
          if (inserted.ok()) *key = *inserted;
          return inserted.status();
        },
        [key, done = std::move(done)](absl::Status status) {
          if (!status.ok()) {
            done(std::move(status));
          } else {
            done(*key);
          }
        });
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

  void DeleteVehicle(VehicleKey key, Done done) override {
    Submit(
        0,
        [this, key](SqliteDatabase& database) {
          const absl::Status status = RemoveVehicle(database, key);
          if (status.ok()) purge_ = true;
          next_sequences_.erase(key);
          return status;
        },
        std::move(done), Need::kLittle);
  }

  void AppendBatch(VehicleKey key, BatchRecord batch,
                   std::optional<std::string> vehicle_payload,
                   Done done) override {
    PendingWrite write;
    write.bytes = batch.payload.size();
    write.done.push_back(std::move(done));
    if (!vehicle_payload.has_value()) {
      write.key = key;
      write.batch = std::move(batch);
      SubmitAppend(std::move(write));
      return;
    }
    write.apply = [this, key, batch = std::move(batch),
                   payload =
                       std::move(vehicle_payload)](SqliteDatabase& database) {
      const absl::Status status = Append(database, key, batch);
      if (!status.ok()) return status;
      return ChangeVehicle(database, key, payload, batch.revision);
    };
    Submit(std::move(write));
  }

  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    Submit(
        // It may be large: nothing shares a transaction with it.
        options_.max_group_bytes,
        [key, batches = std::move(batches),
         revision](SqliteDatabase& database) {
          return ReviseBatchRows(database, key, batches, revision);
        },
        std::move(done));
  }

  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::uint64_t revision, Done done) override {
    Submit(
        0,
        [key, kind, pair = std::move(pair),
         revision](SqliteDatabase& database) {
          return InsertPosePair(database, key, kind, pair, revision);
        },
        std::move(done));
  }

  void DeletePosePair(VehicleKey key, PairKind kind, std::string id,
                      std::uint64_t revision, Done done) override {
    Submit(
        0,
        [key, kind, id = std::move(id), revision](SqliteDatabase& database) {
          return RemovePosePair(database, key, kind, id, revision);
        },
        std::move(done));
  }

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    const std::size_t bytes = payload.size();
    Submit(
        bytes,
        [this, key, last_sequence, payload = std::move(payload),
         revision](SqliteDatabase& database) {
          next_sequences_.erase(key);
          return DropDamagedRows(database, key, last_sequence, payload,
                                 revision);
        },
        std::move(done));
  }

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    absl::StatusOr<VehicleRecord> record = VehicleRecord();
    const absl::Status status = Read([&](SqliteDatabase& database) {
      record = FindVehicle(database, id);
      return record.status();
    });
    if (!status.ok()) return status;
    return record;
  }

  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override {
    absl::StatusOr<std::vector<VehicleRecord>> records =
        std::vector<VehicleRecord>();
    const absl::Status status = Read([&](SqliteDatabase& database) {
      records = FindVehicles(database, after_id, prefix, limit);
      return records.status();
    });
    if (!status.ok()) return status;
    return records;
  }

  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    return Read([&](SqliteDatabase& database) {
      return VisitBatches(database, key, first_sequence, last_sequence, version,
                          visit);
    });
  }

  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override {
    absl::StatusOr<std::vector<PosePairRecord>> pairs =
        std::vector<PosePairRecord>();
    const absl::Status status = Read([&](SqliteDatabase& database) {
      pairs = FindPosePairs(database, key, kind, after_id, limit);
      return pairs.status();
    });
    if (!status.ok()) return status;
    return pairs;
  }

  bool HasRoom() override { return space_.HasRoom(); }

  CommitCounts Counts() const override { return {commits_, writes_}; }

 private:
  using Clock = std::chrono::steady_clock;

  // Whether a write may be taken on where there is little room.
  enum class Need { kRoom, kLittle };

  // One row of `batches`, or something else.
  struct PendingWrite {
    std::size_t bytes = 0;
    // Of a row: one append, or several of a vehicle that follow each other.
    VehicleKey key = 0;
    BatchRecord batch;
    // Of something else: may be called again after it was rolled back.
    std::function<absl::Status(SqliteDatabase&)> apply;
    // Of everything that this is.
    std::vector<Done> done;
    Need need = Need::kRoom;
  };

  void Submit(std::size_t bytes,
              std::function<absl::Status(SqliteDatabase&)> apply, Done done,
              Need need = Need::kRoom) {
    PendingWrite write;
    write.bytes = bytes;
    write.apply = std::move(apply);
    write.done.push_back(std::move(done));
    write.need = need;
    Submit(std::move(write));
  }

  void Submit(PendingWrite write) {
    {
      const MutexLock guard(&mutex_);
      // What comes later of any vehicle must not get before it.
      open_rows_.clear();
      Enqueue(std::move(write));
    }
    wake_.NotifyOne();
  }

  void SubmitAppend(PendingWrite write) {
    bool wake;
    {
      const MutexLock guard(&mutex_);
      wake = queue_.empty();
      const auto open = open_rows_.find(write.key);
      if (open != open_rows_.end() && Join(open->second, &write)) {
        ++waiting_writes_;
      } else {
        Enqueue(std::move(write));
        open_rows_[queue_.back().key] = &queue_.back();
      }
      // One that is busy looks by itself.
      wake = wake || (gathering_ && waiting_writes_ >= last_group_writes_);
    }
    if (wake) wake_.NotifyOne();
  }

  void Enqueue(PendingWrite write) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (queue_.empty()) oldest_submission_ = Clock::now();
    ++waiting_writes_;
    queue_.push_back(std::move(write));
  }

  // Makes an append part of a row that waits, if it follows and fits.
  bool Join(PendingWrite* row, PendingWrite* append) const {
    if (append->batch.first_sequence !=
            row->batch.first_sequence + row->batch.count ||
        row->batch.count + append->batch.count > options_.max_joined_poses ||
        row->bytes + append->bytes > options_.max_joined_bytes) {
      return false;
    }
    row->batch.payload += append->batch.payload;
    row->batch.count += append->batch.count;
    row->batch.revision = append->batch.revision;
    row->bytes += append->bytes;
    row->done.push_back(std::move(append->done.front()));
    return true;
  }

  // The writer's thread.
  void Write() {
    MutexLock lock(&mutex_);
    while (true) {
      // A rest of deleted rows is removed when there is nothing better to do,
      // and left for the next start if the server stops.
      while (!stopping_ && !purge_ && queue_.empty()) wake_.Wait(&mutex_);
      if (queue_.empty() && stopping_) break;
      Gather();
      std::vector<PendingWrite> group;
      std::size_t bytes = 0;
      std::size_t writes = 0;
      while (!queue_.empty() && group.size() < options_.max_group_writes &&
             (group.empty() ||
              bytes + queue_.front().bytes <= options_.max_group_bytes)) {
        bytes += queue_.front().bytes;
        writes += queue_.front().done.size();
        group.push_back(std::move(queue_.front()));
        queue_.pop_front();
      }
      open_rows_.clear();
      waiting_writes_ -= writes;
      last_group_writes_ = writes;
      // Of those that are left behind, near enough.
      oldest_submission_ = Clock::now();
      lock.Unlock();
      const std::vector<absl::Status> results = CommitOrRefuse(group);
      for (std::size_t i = 0; i < group.size(); ++i) {
        for (const Done& done : group[i].done) done(results[i]);
      }
      // What the callbacks hold goes before others are taken on.
      group.clear();
      lock.Lock();
    }
    // Rids the log of a transaction that failed last.
    if (lock_ != nullptr) EnsureWriter().IgnoreError();
  }

  // Waits for more, see SqliteOptions::latency_target.
  void Gather() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (options_.latency_target <= commit_time_) return;
    gathering_ = true;
    while (!stopping_ && !queue_.empty() &&
           waiting_writes_ < last_group_writes_) {
      const Clock::time_point latest =
          oldest_submission_ + options_.latency_target - commit_time_;
      if (wake_.WaitUntil(&mutex_, latest)) break;
    }
    gathering_ = false;
  }

  // What became of each write of a group, for all that it is made of.
  std::vector<absl::Status> CommitOrRefuse(
      const std::vector<PendingWrite>& group) {
    const absl::Status room = lock_ != nullptr ? space_.Check() : ReadOnly();
    const bool is_pointless =
        !room.ok() &&
        std::none_of(group.begin(), group.end(), [](const PendingWrite& write) {
          return write.need == Need::kLittle;
        });
    if (is_pointless || lock_ == nullptr) {
      purge_ = false;
      return std::vector<absl::Status>(group.size(), room);
    }
    const Clock::time_point start = Clock::now();
    std::vector<absl::Status> results = Commit(group, room);
    // Follows the device, and forgets a single slow flush soon.
    commit_time_ += (Clock::now() - start - commit_time_) / 8;
    return results;
  }

  // Writes a group in one transaction, without `room` what needs little of it.
  std::vector<absl::Status> Commit(const std::vector<PendingWrite>& group,
                                   const absl::Status& room) {
    std::vector<absl::Status> results;
    absl::Status status = EnsureWriter();
    if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
    const bool begun = status.ok();
    // Rows are inserted without a savepoint each, which costs more than the
    // insertion. Should one of them damage the transaction, which takes a
    // damaged file or a full disk, all is begun again with savepoints.
    if (begun && !ApplyAll(group, room, /*careful=*/false, &results, &status)) {
      next_sequences_.clear();
      status = writer_->Prepare("ROLLBACK").Run();
      if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
      if (status.ok()) {
        ApplyAll(group, room, /*careful=*/true, &results, &status);
      }
    }
    bool purged = false;
    if (status.ok() && purge_) {
      const absl::StatusOr<bool> more = PurgeSome(*writer_);
      status = more.status();
      purged = more.ok() && *more;
      purge_ = purged;
    }
    if (status.ok()) status = writer_->Prepare("COMMIT").Run();
    if (status.ok()) {
      space_.NoteWrite(/*found_full=*/false);
      Count(group, results);
      // Where all was refused there was nothing to flush, and the log may have
      // been begun anew without a commit in it.
      if (purged ||
          std::any_of(results.begin(), results.end(),
                      [](const absl::Status& result) { return result.ok(); })) {
        const absl::StatusOr<LogPosition> flushed = writer_->LogEnd();
        if (flushed.ok()) mark_->Write(*flushed);
      }
      if (IsFailedFlush(writer_->copy_failure())) {
        GiveUp(writer_->copy_failure());
      }
      return results;
    }

    // Whatever is left is in doubt; see the header. Where not even BEGIN
    // succeeded, nothing was touched.
    if (begun) writer_.reset();
    next_sequences_.clear();
    // Else a full disk would be asked again and again. Taken up after the next
    // delete or start.
    purge_ = false;
    const std::string message =
        "nothing was written: " + std::string(status.message());
    absl::Status failure =
        Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
    if (IsStorageFull(status)) {
      space_.NoteWrite(/*found_full=*/true);
      failure = StorageFull(message);
    }
    if (IsFailedFlush(status)) {
      GiveUp(status);
      failure = given_up_;
    }
    return std::vector<absl::Status>(group.size(), failure);
  }

  // What a transaction that was committed held.
  void Count(const std::vector<PendingWrite>& group,
             const std::vector<absl::Status>& results) {
    std::uint64_t writes = 0;
    for (std::size_t i = 0; i < group.size(); ++i) {
      if (results[i].ok()) writes += group[i].done.size();
    }
    if (writes > 0) ++commits_;
    writes_ += writes;
  }

  static absl::Status ReadOnly() {
    return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                 "this store was opened for reading");
  }

  // After a failed flush; see the header.
  void GiveUp(const absl::Status& cause) {
    if (!given_up_.ok()) return;
    given_up_ = Error(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                      "the store takes no more writes, since a flush failed: " +
                          std::string(cause.message()));
    if (options_.on_failed_flush) options_.on_failed_flush(given_up_);
  }

  // Answers whether all writes could be applied or refused; `status` is not OK
  // if the transaction cannot go on.
  bool ApplyAll(const std::vector<PendingWrite>& group,
                const absl::Status& room, bool careful,
                std::vector<absl::Status>* results, absl::Status* status) {
    results->clear();
    for (const PendingWrite& write : group) {
      if (!room.ok() && write.need == Need::kRoom) {
        // Nothing was touched: what comes next of its vehicle is as it was.
        results->push_back(room);
        continue;
      }
      if (careful || write.apply) {
        results->emplace_back();
        *status = ApplyAlone(write, &results->back());
        if (!status->ok()) return true;
        continue;
      }
      absl::Status result = Append(*writer_, write.key, write.batch);
      // SQLite gives up the whole transaction after some errors.
      if (result.code() == StatusCode::kUnavailable ||
          !writer_->InTransaction()) {
        *status = std::move(result);
        return true;
      }
      // A row that does not follow was refused before anything was touched.
      if (!result.ok() && result.code() != StatusCode::kFailedPrecondition &&
          result.code() != StatusCode::kNotFound) {
        return false;
      }
      results->push_back(std::move(result));
    }
    return true;
  }

  absl::Status Apply(SqliteDatabase& database, const PendingWrite& write) {
    return write.apply ? write.apply(database)
                       : Append(database, write.key, write.batch);
  }

  absl::Status Append(SqliteDatabase& database, VehicleKey key,
                      const BatchRecord& batch) {
    if (next_sequences_.size() >= kMaxKnownSequences) next_sequences_.clear();
    std::uint64_t& next = next_sequences_[key];
    const absl::Status status = InsertBatch(database, key, batch, &next);
    // What a refused write did is rolled back.
    if (!status.ok()) next_sequences_.erase(key);
    return status;
  }

  // Applies one write so that, refused, it leaves nothing behind. Answers not
  // OK if the transaction cannot go on.
  absl::Status ApplyAlone(const PendingWrite& write, absl::Status* result) {
    absl::Status status = writer_->Prepare("SAVEPOINT one").Run();
    if (!status.ok()) return status;
    *result = Apply(*writer_, write);
    if (result->code() == StatusCode::kUnavailable) return *result;
    // SQLite gives up the whole transaction after some errors.
    if (!writer_->InTransaction()) return *result;
    if (!result->ok()) {
      next_sequences_.clear();
      status = writer_->Prepare("ROLLBACK TO one").Run();
      if (!status.ok()) return status;
    }
    return writer_->Prepare("RELEASE one").Run();
  }

  absl::Status EnsureWriter() {
    if (!given_up_.ok()) return given_up_;
    if (writer_ != nullptr) return absl::OkStatus();
    absl::StatusOr<std::unique_ptr<SqliteDatabase>> opened =
        OpenWriter(path_, options_.vfs, mark_.get());
    if (!opened.ok()) return opened.status();
    writer_ = *std::move(opened);
    return absl::OkStatus();
  }

  // Runs `read` on a connection of its own, all of it at one moment.
  template <typename Function>
  absl::Status Read(const Function& read) {
    std::unique_ptr<SqliteDatabase> reader;
    {
      const MutexLock guard(&readers_mutex_);
      if (!idle_readers_.empty()) {
        reader = std::move(idle_readers_.back());
        idle_readers_.pop_back();
      }
    }
    if (reader == nullptr) {
      absl::StatusOr<std::unique_ptr<SqliteDatabase>> opened =
          SqliteDatabase::Open(path_, SqliteDatabase::Mode::kReadOnly,
                               options_.vfs);
      if (!opened.ok()) return opened.status();
      reader = *std::move(opened);
    }
    absl::Status status = reader->Prepare("BEGIN").Run();
    if (status.ok()) {
      status = read(*reader);
      // Nothing to commit, but the moment must end.
      const absl::Status ended = reader->Prepare("COMMIT").Run();
      if (status.ok()) status = ended;
    }
    const bool usable = !reader->InTransaction();
    const MutexLock guard(&readers_mutex_);
    if (usable && idle_readers_.size() < kIdleReaders) {
      idle_readers_.push_back(std::move(reader));
    }
    return status;
  }

  const std::string path_;
  const SqliteOptions options_;
  // Nothing if opened for reading; so is the mark.
  const std::unique_ptr<StoreLock> lock_;
  const std::unique_ptr<DurableMark> mark_;

  FreeSpaceGuard space_;
  // The writer's thread only, once it runs.
  // Why no write is taken on any more.
  absl::Status given_up_;
  // Nothing after a failure.
  std::unique_ptr<SqliteDatabase> writer_;
  bool purge_ = true;
  // The sequence that comes next of vehicles that were written to, as the
  // transaction under way would have it. Forgotten when that is in doubt.
  std::unordered_map<VehicleKey, std::uint64_t> next_sequences_;
  // What a commit takes.
  Clock::duration commit_time_{0};
  // Written by that thread.
  std::atomic<std::uint64_t> commits_{0};
  std::atomic<std::uint64_t> writes_{0};

  // Keeps the log's index in shared memory while the writer is opened anew: it
  // would otherwise be made from the log, failed transactions included.
  const std::unique_ptr<SqliteDatabase> anchor_;

  Mutex mutex_;
  CondVar wake_;
  std::deque<PendingWrite> queue_ ABSL_GUARDED_BY(mutex_);
  // By vehicle, the row in the queue that appends may still join.
  std::unordered_map<VehicleKey, PendingWrite*> open_rows_
      ABSL_GUARDED_BY(mutex_);
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // In the queue, each batch of a row counted.
  std::size_t waiting_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  std::size_t last_group_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  // Of the first in the queue, or when the last group was taken.
  Clock::time_point oldest_submission_ ABSL_GUARDED_BY(mutex_);
  bool gathering_ ABSL_GUARDED_BY(mutex_) = false;

  Mutex readers_mutex_;
  std::vector<std::unique_ptr<SqliteDatabase>> idle_readers_
      ABSL_GUARDED_BY(readers_mutex_);

  std::thread thread_;
};

// Two names of one file must find the same lock.
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
  absl::StatusOr<std::unique_ptr<StoreLock>> lock = StoreLock::Acquire(store);
  if (!lock.ok()) return lock.status();
  absl::StatusOr<std::unique_ptr<DurableMark>> mark = DurableMark::Open(store);
  if (!mark.ok()) return mark.status();
  const absl::Status whole =
      CheckLog(store, options.drop_damaged_log, options.warn, mark->get());
  if (!whole.ok()) return whole;
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> writer =
      OpenWriter(store, options.vfs, mark->get());
  if (IsStorageFull(writer.status()) && GiveUpReserve(store)) {
    writer = OpenWriter(store, options.vfs, mark->get());
  }
  if (!writer.ok() && !IsStorageFull(writer.status())) return writer.status();
  if (!writer.ok()) {
    // What is told to be durable from here on must be, at least as far as the
    // log goes.
    const absl::Status flushed = FlushFile(store + "-wal");
    if (!flushed.ok()) return flushed;
    if (options.warn) {
      options.warn("nothing can be written until there is room: " +
                   std::string(writer.status().message()));
    }
  }
  if (writer.ok() && options.drop_damaged_log) {
    // Else what was dropped could be back after a power failure.
    const absl::Status dropped = FlushFile(store + "-wal");
    if (!dropped.ok()) return dropped;
  }
  // Also of a store that is not new: the server that made it may have been
  // killed before it came to this.
  const absl::Status found = FlushDirectories(
      std::filesystem::path(store).parent_path().string());
  if (!found.ok()) return found;
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenAnchor(store, options.vfs);
  if (!anchor.ok()) return anchor.status();
  const absl::Status sound =
      CheckFile(**anchor, store, options.max_checked_bytes);
  if (!sound.ok()) return sound;
  if (writer.ok()) KeepReserve(store);
  return std::unique_ptr<Storage>(new SqliteStorage(
      store, options, *std::move(lock), *std::move(mark),
      writer.ok() ? *std::move(writer) : nullptr, *std::move(anchor)));
}

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorageToRead(
    const std::string& path) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenDatabaseToRead(path);
  if (!anchor.ok()) return anchor.status();
  return std::unique_ptr<Storage>(new SqliteStorage(
      path, SqliteOptions(), nullptr, nullptr, nullptr, *std::move(anchor)));
}

}  // namespace revisit::server
