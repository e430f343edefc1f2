#include "server/storage/sqlite/sqlite_storage.h"

#include <pthread.h>

#include <atomic>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <system_error>
#include <thread>
#include <unordered_map>
#include <utility>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/reader_pool.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_opening.h"
#include "server/storage/sqlite/store_rows.h"
#include "server/storage/write_queue.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// How long chores rest after a transaction has failed.
constexpr std::chrono::milliseconds kChoresDelay{1000};

// Batches of deleted vehicles that one transaction removes: few where there is
// no room, because Debian's SQLite writes each page that it frees.
constexpr int kPurgedBatches = 32;
constexpr int kPurgedBatchesWithoutRoom = 2;

// Free pages that the file keeps for coming writes, 8 MiB, and how many are
// given back in one transaction, 2 MiB. Where there is no room, none are kept
// and few are given back.
constexpr std::int64_t kKeptPages = 1024;
constexpr std::int64_t kGivenPages = 256;
constexpr std::int64_t kGivenPagesWithoutRoom = 16;

// Vehicles for which the writer remembers the sequence that comes next.
constexpr std::size_t kMaxKnownSequences = 100'000;

class SqliteStorage : public Storage {
 public:
  // A storage that writes.
  SqliteStorage(std::string path, const SqliteOptions& options,
                std::uint64_t run, std::unique_ptr<StoreLock> lock,
                std::unique_ptr<DurableMark> mark, OpenedWriter writer,
                std::unique_ptr<SqliteDatabase> anchor)
      : path_(std::move(path)),
        options_(options),
        run_(run),
        lock_(std::move(lock)),
        mark_(std::move(mark)),
        watch_(path_),
        space_(
            options.min_free_bytes,
            [file = path_] {
              return FreeBytes(std::filesystem::path(file).parent_path());
            },
            [this] { return FreeBytesInside(); }),
        writer_(std::move(writer.database)),
        state_(writer.state),
        anchor_(std::move(anchor)),
        readers_(path_, SqliteDatabase::Mode::kReadOnly, options.vfs),
        queue_(options),
        thread_([this] { Write(); }) {
    // Names the thread for tools that list threads.
    pthread_setname_np(thread_.native_handle(), "store-writer");
  }

  // A storage that only reads.
  SqliteStorage(std::string path, SqliteDatabase::Mode reader_mode,
                std::unique_ptr<SqliteDatabase> anchor)
      : path_(std::move(path)),
        run_(0),
        watch_(path_),
        space_(0, nullptr, nullptr),
        anchor_(std::move(anchor)),
        readers_(path_, reader_mode, ""),
        queue_(options_),
        thread_([this] { Write(); }) {}

  ~SqliteStorage() override {
    queue_.Stop();
    thread_.join();
    if (lock_ != nullptr) Close();
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    const std::size_t bytes = record.payload.size();
    auto key = std::make_shared<VehicleKey>(0);
    Submit(
        bytes,
        [this, record = std::move(record), key] {
          const absl::StatusOr<VehicleKey> inserted =
              InsertVehicle(*writer_, record);
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
        [this, key, payload = std::move(payload), revision] {
          return ChangeVehicle(*writer_, key, payload, revision);
        },
        std::move(done));
  }

  void DeleteVehicle(VehicleKey key, Done done) override {
    Submit(
        0,
        [this, key] {
          const absl::Status status = RemoveVehicle(*writer_, key);
          if (status.ok()) chores_ = Chores::kPurge;
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
      queue_.SubmitAppend(std::move(write));
      return;
    }
    write.apply = [this, key, batch = std::move(batch),
                   payload = std::move(vehicle_payload)] {
      const absl::Status status = Append(key, batch);
      if (!status.ok()) return status;
      return ChangeVehicle(*writer_, key, payload, batch.revision);
    };
    queue_.Submit(std::move(write));
  }

  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    Submit(
        // A revision may be large: nothing shares a transaction with it.
        options_.max_group_bytes,
        [this, key, batches = std::move(batches), revision] {
          chores_ = Chores::kPurge;
          return ReviseBatchRows(*writer_, key, batches, revision);
        },
        std::move(done));
  }

  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::uint64_t revision, Done done) override {
    Submit(
        0,
        [this, key, kind, pair = std::move(pair), revision] {
          return InsertPosePair(*writer_, key, kind, pair, revision);
        },
        std::move(done));
  }

  void DeletePosePair(VehicleKey key, PairKind kind, std::string id,
                      std::uint64_t revision, Done done) override {
    Submit(
        0,
        [this, key, kind, id = std::move(id), revision] {
          return RemovePosePair(*writer_, key, kind, id, revision);
        },
        std::move(done));
  }

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    const std::size_t bytes = payload.size();
    Submit(
        bytes,
        [this, key, last_sequence, payload = std::move(payload), revision] {
          next_sequences_.erase(key);
          chores_ = Chores::kPurge;
          return DropDamagedRows(*writer_, key, last_sequence, payload,
                                 revision);
        },
        std::move(done));
  }

  bool KeepsSnapshots() const override { return true; }

  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override {
    const std::size_t bytes = part.size();
    Submit(
        bytes,
        [this, key, number, part = std::move(part)] {
          if (number == 0) chores_ = Chores::kPurge;
          return PutSnapshotPartRow(*writer_, key, number, part);
        },
        std::move(done));
  }

  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                   Done done) override {
    const std::size_t bytes = snapshot.payload.size();
    Submit(
        bytes,
        [this, key, snapshot = std::move(snapshot)] {
          return PutSnapshotRow(*writer_, key, snapshot);
        },
        std::move(done));
  }

  void DropSnapshot(VehicleKey key, Done done) override {
    Submit(
        0,
        [this, key] {
          chores_ = Chores::kPurge;
          return DropSnapshotRow(*writer_, key);
        },
        std::move(done), Need::kLittle);
  }

  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override {
    absl::StatusOr<std::optional<SnapshotRecord>> snapshot =
        std::optional<SnapshotRecord>();
    const absl::Status status = readers_.Read([&](SqliteDatabase& database) {
      snapshot = FindSnapshot(database, key);
      return snapshot.status();
    });
    if (!status.ok()) return status;
    return snapshot;
  }

  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override {
    return readers_.Read([&](SqliteDatabase& database) {
      return VisitSnapshotParts(database, key, first, end, visit);
    });
  }

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    absl::StatusOr<VehicleRecord> record = VehicleRecord();
    const absl::Status status = readers_.Read([&](SqliteDatabase& database) {
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
    const absl::Status status = readers_.Read([&](SqliteDatabase& database) {
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
    return readers_.Read([&](SqliteDatabase& database) {
      return VisitBatches(database, key, first_sequence, last_sequence, version,
                          visit);
    });
  }

  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override {
    absl::StatusOr<std::vector<PosePairRecord>> pairs =
        std::vector<PosePairRecord>();
    const absl::Status status = readers_.Read([&](SqliteDatabase& database) {
      pairs = FindPosePairs(database, key, kind, after_id, limit);
      return pairs.status();
    });
    if (!status.ok()) return status;
    return pairs;
  }

  absl::Status CheckWritable() override {
    return space_.HasRoom() ? absl::OkStatus()
                            : StorageFull("the disk of the store is full");
  }

  CommitCounts Counts() const override {
    return {commits_, writes_, commit_seconds_.Read(), flush_seconds_.Read()};
  }

  std::optional<StorageRoom> GetRoom() const override {
    StorageRoom room;
    for (const std::string& file : {path_, LogOf(path_)}) {
      std::error_code error;
      const std::uintmax_t bytes = std::filesystem::file_size(file, error);
      if (!error) room.bytes += static_cast<std::int64_t>(bytes);
    }
    const absl::StatusOr<std::int64_t> free =
        FreeBytes(std::filesystem::path(path_).parent_path());
    if (!free.ok()) return std::nullopt;
    room.free_bytes = *free;
    return room;
  }

 private:
  using Clock = std::chrono::steady_clock;

  using Need = PendingWrite::Need;

  // Work for when there is nothing better to do, in this order: removing rows
  // of deleted vehicles, then giving back unused room in the file.
  enum class Chores { kNone, kPurge, kShrink };

  void Submit(std::size_t bytes, std::function<absl::Status()> apply, Done done,
              Need need = Need::kRoom) {
    PendingWrite write;
    write.bytes = bytes;
    write.apply = std::move(apply);
    write.done.push_back(std::move(done));
    write.need = need;
    queue_.Submit(std::move(write));
  }

  // The writer's thread.
  void Write() {
    while (auto group = queue_.Take(ChoresDue(), commit_time_)) {
      const std::vector<absl::Status> results = CommitOrRefuse(*group);
      for (std::size_t i = 0; i < group->size(); ++i) {
        for (const Done& done : (*group)[i].done) done(results[i]);
      }
      // Destroys the callbacks, and what they hold, before the next group is
      // taken.
      group->clear();
    }
  }

  std::optional<Clock::time_point> ChoresDue() const {
    if (chores_ == Chores::kNone) return std::nullopt;
    return chores_due_;
  }

  bool ChoresAreDue() const {
    return chores_ != Chores::kNone && Clock::now() >= chores_due_;
  }

  // Commits a group; returns the outcome of each write, which holds for all
  // appends that it joins.
  std::vector<absl::Status> CommitOrRefuse(
      const std::vector<PendingWrite>& group) {
    const absl::Status room = lock_ != nullptr ? space_.Check() : ReadOnly();
    if (lock_ == nullptr) {
      chores_ = Chores::kNone;
      return std::vector<absl::Status>(group.size(), room);
    }
    // The log is copied into the database while there is still room, so that
    // writes which make room can write over it.
    if (!room.ok() && had_room_ && writer_ != nullptr) {
      writer_->CopyLog().IgnoreError();
    }
    had_room_ = room.ok();
    if (!room.ok() && !MakesRoom(group)) {
      return std::vector<absl::Status>(group.size(), room);
    }
    if (room.ok() && gave_up_reserve_) {
      KeepReserve(path_);
      gave_up_reserve_ = false;
    }
    const Clock::time_point start = Clock::now();
    std::vector<absl::Status> results = Commit(group, room);
    const Clock::duration taken = Clock::now() - start;
    // A moving mean follows the device, and soon forgets a single slow flush.
    commit_time_ += (taken - commit_time_) / 8;
    if (!group.empty()) commit_seconds_.Observe(taken);
    return results;
  }

  // Whether the group or the chores leave more room than there was.
  bool MakesRoom(const std::vector<PendingWrite>& group) const {
    return ChoresAreDue() || std::any_of(group.begin(), group.end(),
                                         [](const PendingWrite& write) {
                                           return write.need == Need::kLittle;
                                         });
  }

  // Writes a group in one transaction; without `room`, only writes that need
  // little.
  std::vector<absl::Status> Commit(const std::vector<PendingWrite>& group,
                                   const absl::Status& room) {
    std::vector<absl::Status> results;
    absl::Status status = EnsureWriter();
    if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
    const bool begun = status.ok();
    // Rows are inserted without a savepoint each, which costs more than the
    // insertion. If one of them damages the transaction, which happens only
    // with a damaged file or a full disk, all is begun again with savepoints.
    if (begun && !ApplyAll(group, room, /*careful=*/false, &results, &status)) {
      next_sequences_.clear();
      status = writer_->Prepare("ROLLBACK").Run();
      if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
      if (status.ok()) {
        ApplyAll(group, room, /*careful=*/true, &results, &status);
      }
    }
    bool changed =
        std::any_of(results.begin(), results.end(),
                    [](const absl::Status& result) { return result.ok(); });
    // While the store lives on its reserve, a deletion comes first, alone.
    if (status.ok() && ChoresAreDue() &&
        (group.empty() || !lives_on_reserve_)) {
      const absl::StatusOr<bool> done =
          DoChores(/*has_time=*/group.empty(), /*has_room=*/room.ok());
      status = done.status();
      changed |= done.ok() && *done;
    }
    StoreState next = NextState(state_, run_, /*is_closed=*/false);
    if (status.ok() && changed) status = WriteState(*writer_, next);
    const Clock::time_point flush = Clock::now();
    if (status.ok()) status = writer_->Prepare("COMMIT").Run();
    if (status.ok() && changed) {
      flush_seconds_.Observe(Clock::now() - flush);
      status = watch_.Check();
      if (!status.ok()) GiveUp(status);
    }
    if (status.ok()) {
      space_.NoteWrite(/*found_full=*/false);
      Count(group, results);
      if (changed) NoteCommit(next);
      if (chores_ == Chores::kNone ? gave_pages_ || !room.ok()
                                   : !room.ok() && !lives_on_reserve_) {
        // Copying makes the file shorter, and lets the log be written over.
        CheckCopied(writer_->CopyLog().status());
        gave_pages_ = false;
        lives_on_reserve_ = false;
      }
      CheckCopied(writer_->copy_failure());
      return results;
    }

    // The state of the transaction is in doubt, so the connection is closed;
    // see the header. If not even BEGIN succeeded, nothing was touched.
    if (begun) writer_.reset();
    next_sequences_.clear();
    lives_on_reserve_ = false;
    const bool makes_room = MakesRoom(group);
    // Without a delay a full disk would be tried again and again.
    chores_due_ = Clock::now() + kChoresDelay;
    const std::string message =
        "nothing was written: " + std::string(status.message());
    absl::Status failure =
        Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
    if (IsStorageFull(status)) {
      space_.NoteWrite(/*found_full=*/true);
      failure = StorageFull(message);
    }
    if (IsFailedFlush(status)) GiveUp(status);
    if (!given_up_.ok()) failure = given_up_;
    if (IsStorageFull(failure) && makes_room && GiveUpReserve(path_)) {
      gave_up_reserve_ = true;
      lives_on_reserve_ = true;
      chores_due_ = Clock::now();
      return Commit(group, failure);
    }
    return std::vector<absl::Status>(group.size(), failure);
  }

  // Does a step of the chores, within a transaction; returns whether it changed
  // anything.
  absl::StatusOr<bool> DoChores(bool has_time, bool has_room) {
    if (chores_ == Chores::kPurge) {
      const absl::StatusOr<bool> more = PurgeSome(
          *writer_, has_room ? kPurgedBatches : kPurgedBatchesWithoutRoom);
      if (!more.ok()) return more;
      if (!*more) chores_ = Chores::kShrink;
      return *more;
    }
    // Giving back moves pages, which takes longer than the waiting writes.
    if (!has_time && has_room) return false;
    const absl::StatusOr<std::int64_t> given =
        has_room ? GiveBackPages(*writer_, kKeptPages, kGivenPages)
                 : GiveBackPages(*writer_, 0, kGivenPagesWithoutRoom);
    if (!given.ok()) return given.status();
    if (*given == 0) {
      chores_ = Chores::kNone;
    } else {
      gave_pages_ = true;
    }
    return *given > 0;
  }

  // Call after each commit.
  void NoteCommit(const StoreState& state) {
    const bool is_first = state_.run != run_;
    state_ = state;
    mark_->Write(state_);
    if (is_first) lock_->Write(state_);
  }

  void CheckCopied(const absl::Status& copied) {
    if (IsFailedFlush(copied)) GiveUp(copied);
  }

  // Free bytes in the file itself, as far as SQLite can use them.
  std::int64_t FreeBytesInside() {
    if (writer_ == nullptr) return 0;
    const absl::StatusOr<std::int64_t> pages =
        writer_->QueryInteger("PRAGMA freelist_count");
    const absl::StatusOr<std::int64_t> page_bytes =
        writer_->QueryInteger("PRAGMA page_size");
    return pages.ok() && page_bytes.ok() ? *pages * *page_bytes : 0;
  }

  // Ends in order: the database alone is the store, and says so. If that cannot
  // be written, the log stays, as after a kill.
  void Close() {
    if (!EnsureWriter().ok() || !watch_.Check().ok()) return;
    if (!state_.is_closed) {
      const StoreState closed = NextState(state_, run_, /*is_closed=*/true);
      absl::Status status = writer_->Prepare("BEGIN IMMEDIATE").Run();
      if (status.ok()) status = WriteState(*writer_, closed);
      if (status.ok()) status = writer_->Prepare("COMMIT").Run();
      if (!status.ok()) return;
      NoteCommit(closed);
      lock_->Write(closed);
    }
    const absl::StatusOr<bool> copied = writer_->CopyLog();
    if (copied.ok() && *copied && mark_->Flush(state_).ok()) {
      writer_->KeepLogOnClose(false);
    }
  }

  // Counts the writes of a committed transaction.
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

  // Takes no write any more, after a failed flush or if the files are gone; see
  // the header.
  void GiveUp(const absl::Status& cause) {
    if (!given_up_.ok()) return;
    given_up_ = Error(StatusCode::kUnavailable, ReasonOf(cause),
                      std::string("the store takes no more writes, since ") +
                          (IsFailedFlush(cause) ? "a flush failed: " : "") +
                          std::string(cause.message()));
    chores_ = Chores::kNone;
    if (options_.on_failure) options_.on_failure(given_up_);
  }

  // Applies or refuses each write; returns whether that was possible for all.
  // `status` is not OK if the transaction cannot go on.
  bool ApplyAll(const std::vector<PendingWrite>& group,
                const absl::Status& room, bool careful,
                std::vector<absl::Status>* results, absl::Status* status) {
    results->clear();
    for (const PendingWrite& write : group) {
      if (!room.ok() && write.need == Need::kRoom) {
        // Nothing was touched: the vehicle's next sequence is as it was.
        results->push_back(room);
        continue;
      }
      if (careful || write.apply) {
        results->emplace_back();
        *status = ApplyAlone(write, &results->back());
        if (!status->ok()) return true;
        continue;
      }
      absl::Status result = Append(write.key, write.batch);
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

  absl::Status Apply(const PendingWrite& write) {
    return write.apply ? write.apply() : Append(write.key, write.batch);
  }

  absl::Status Append(VehicleKey key, const BatchRecord& batch) {
    if (next_sequences_.size() >= kMaxKnownSequences) next_sequences_.clear();
    std::uint64_t& next = next_sequences_[key];
    const absl::Status status = InsertBatch(*writer_, key, batch, &next);
    // A refused write is rolled back, so `next` may be wrong.
    if (!status.ok()) next_sequences_.erase(key);
    return status;
  }

  // Applies one write so that it leaves nothing behind if it is refused. The
  // returned status is not OK if the transaction cannot go on.
  absl::Status ApplyAlone(const PendingWrite& write, absl::Status* result) {
    absl::Status status = writer_->Prepare("SAVEPOINT one").Run();
    if (!status.ok()) return status;
    *result = Apply(write);
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
    const absl::Status is_there = watch_.Check();
    if (!is_there.ok()) {
      GiveUp(is_there);
      return given_up_;
    }
    // If the log is not copied now, because somebody reads or there is no room,
    // it is as good as before: this process has seen it flushed.
    absl::StatusOr<OpenedWriter> opened =
        OpenWriter(path_, options_.vfs, run_, mark_.get(),
                   /*copies_log=*/!lives_on_reserve_);
    if (!opened.ok()) return opened.status();
    writer_ = std::move(opened->database);
    state_ = opened->state;
    return absl::OkStatus();
  }

  const std::string path_;
  const SqliteOptions options_;
  const std::uint64_t run_;
  // Null if opened for reading, as is the mark.
  const std::unique_ptr<StoreLock> lock_;
  const std::unique_ptr<DurableMark> mark_;
  const FileWatch watch_;

  FreeSpaceGuard space_;
  // From here to `commits_`, members are used by the writer's thread only, once
  // it runs.
  //
  // Why no write is taken any more; OK as long as writes are taken.
  absl::Status given_up_;
  // Null after a failure, until it is opened anew.
  std::unique_ptr<SqliteDatabase> writer_;
  // State of the last commit.
  StoreState state_;
  // Starts with the purge, because the server before may have left rows of
  // deleted vehicles.
  Chores chores_ = Chores::kPurge;
  Clock::time_point chores_due_;
  // Whether pages were given back since the log was copied last.
  bool gave_pages_ = false;
  bool had_room_ = true;
  bool gave_up_reserve_ = false;
  // Whether the room of the reserve, since it was given up, is still needed for
  // the chores' writes to the log. Copying the log would take that room, as
  // long as the file has to grow for it.
  bool lives_on_reserve_ = false;
  // Next sequence of vehicles that were written to, as of the transaction under
  // way. Forgotten when it is in doubt.
  std::unordered_map<VehicleKey, std::uint64_t> next_sequences_;
  // Mean time of a commit.
  Clock::duration commit_time_{0};
  // Written by the writer's thread, read by others.
  std::atomic<std::uint64_t> commits_{0};
  std::atomic<std::uint64_t> writes_{0};
  Histogram commit_seconds_{SecondsBounds()};
  Histogram flush_seconds_{SecondsBounds()};

  // Keeps the log's index in shared memory while the writer is opened anew:
  // otherwise it would be made from the log, including failed transactions.
  const std::unique_ptr<SqliteDatabase> anchor_;

  ReaderPool readers_;
  WriteQueue queue_;
  std::thread thread_;
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
  return std::unique_ptr<Storage>(
      new SqliteStorage(store, options, run, *std::move(lock), *std::move(mark),
                        *std::move(writer), *std::move(anchor)));
}

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorageToRead(
    const std::string& path, SqliteDatabase::Mode mode) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenDatabaseToRead(path, mode);
  if (!anchor.ok()) return anchor.status();
  return std::unique_ptr<Storage>(
      new SqliteStorage(path, mode, *std::move(anchor)));
}

}  // namespace revisit::server
