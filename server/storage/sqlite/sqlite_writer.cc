#include "server/storage/sqlite/sqlite_writer.h"

#include <pthread.h>

#include <algorithm>
#include <filesystem>
#include <utility>

#include "server/base/status.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/freed_room.h"
#include "server/storage/sqlite/vehicle_rows.h"

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

// Whether a row that was inserted without a savepoint has left the others of
// its transaction sound: it is there, or was refused before anything was
// touched.
bool LeavesOthersSound(const absl::Status& result) {
  return result.ok() || result.code() == StatusCode::kFailedPrecondition ||
         result.code() == StatusCode::kNotFound;
}

}  // namespace

SqliteWriter::SqliteWriter(std::string path, const SqliteOptions& options,
                           std::uint64_t run, std::unique_ptr<StoreLock> lock,
                           std::unique_ptr<DurableMark> mark,
                           OpenedWriter opened)
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
      database_(std::move(opened.database)),
      state_(opened.state),
      queue_(options),
      thread_([this] { Write(); }) {
  // Names the thread for tools that list threads.
  pthread_setname_np(thread_.native_handle(), "store-writer");
}

SqliteWriter::~SqliteWriter() { End(); }

void SqliteWriter::End() {
  if (!thread_.joinable()) return;
  queue_.Stop();
  thread_.join();
  Close();
}

void SqliteWriter::Append(VehicleKey key, std::vector<BatchRecord> batches,
                          std::optional<std::string> vehicle_payload,
                          Storage::Done done) {
  PendingWrite write;
  for (const BatchRecord& batch : batches) {
    write.bytes += batch.payload.size();
  }
  write.done.push_back(std::move(done));
  if (!vehicle_payload && batches.size() == 1) {
    write.key = key;
    write.rows = std::move(batches);
    queue_.SubmitAppend(std::move(write));
    return;
  }
  write.apply = [this, key, batches = std::move(batches),
                 payload = std::move(vehicle_payload)] {
    for (const BatchRecord& batch : batches) {
      absl::Status status = Insert(key, batch);
      if (!status.ok()) return status;
    }
    if (!payload) return absl::OkStatus();
    return ChangeVehicle(*database_, key, payload, batches.back().revision);
  };
  queue_.Submit(std::move(write));
}

void SqliteWriter::Submit(std::size_t bytes, Change change, Storage::Done done,
                          PendingWrite::Need need) {
  PendingWrite write;
  write.bytes = bytes;
  write.apply = [this, change = std::move(change)] {
    return change(*database_);
  };
  write.done.push_back(std::move(done));
  write.need = need;
  queue_.Submit(std::move(write));
}

void SqliteWriter::Write() {
  while (auto group = queue_.Take(ChoresDue(), commit_time_)) {
    const Results results = CommitOrRefuse(*group);
    for (std::size_t i = 0; i < group->size(); ++i) {
      for (const Storage::Done& done : (*group)[i].done) done(results[i]);
    }
    // Destroys the callbacks, and what they hold, before the next group is
    // taken.
    group->clear();
  }
}

std::optional<SqliteWriter::Clock::time_point> SqliteWriter::ChoresDue() const {
  if (chores_ == Chores::kNone) return std::nullopt;
  return chores_due_;
}

bool SqliteWriter::ChoresAreDue() const {
  return chores_ != Chores::kNone && Clock::now() >= chores_due_;
}

SqliteWriter::Results SqliteWriter::CommitOrRefuse(
    const std::vector<PendingWrite>& group) {
  const absl::Status room = space_.Check();
  // The log is copied into the database while there is still room, so that
  // writes which make room can write over it.
  if (!room.ok() && had_room_ && database_ != nullptr) {
    database_->CopyLog().IgnoreError();
  }
  had_room_ = room.ok();
  if (!room.ok() && !MakesRoom(group)) {
    return Results(group.size(), room);
  }
  if (room.ok() && gave_up_reserve_) {
    KeepReserve(path_);
    gave_up_reserve_ = false;
  }
  const Clock::time_point start = Clock::now();
  Results results = Commit(group, room);
  const Clock::duration taken = Clock::now() - start;
  // A moving mean follows the device, and soon forgets a single slow flush.
  commit_time_ += (taken - commit_time_) / 8;
  if (!group.empty()) commit_seconds_.Observe(taken);
  return results;
}

bool SqliteWriter::MakesRoom(const std::vector<PendingWrite>& group) const {
  return ChoresAreDue() ||
         std::any_of(group.begin(), group.end(), [](const PendingWrite& write) {
           return write.need == Need::kLittle;
         });
}

SqliteWriter::Results SqliteWriter::Commit(
    const std::vector<PendingWrite>& group, absl::Status room) {
  while (true) {
    absl::StatusOr<Results> results = Transact(group, room);
    if (results.ok()) return *std::move(results);
    const bool makes_room = MakesRoom(group);
    absl::Status failure = NoteFailure(results.status());
    if (!IsStorageFull(failure) || !makes_room || !TakeReserve()) {
      return Results(group.size(), failure);
    }
    // Once more, in the room of the reserve, which is given up only once.
    room = std::move(failure);
  }
}

absl::StatusOr<SqliteWriter::Results> SqliteWriter::Transact(
    const std::vector<PendingWrite>& group, const absl::Status& room) {
  absl::Status status = EnsureDatabase();
  if (status.ok()) status = database_->Prepare("BEGIN IMMEDIATE").Run();
  // Nothing was touched yet, so the connection is as good as before.
  if (!status.ok()) return status;
  absl::StatusOr<Results> results = FillAndCommit(group, room);
  // Otherwise the state of the transaction is in doubt; see sqlite_storage.h.
  if (!results.ok()) database_.reset();
  return results;
}

absl::StatusOr<SqliteWriter::Results> SqliteWriter::FillAndCommit(
    const std::vector<PendingWrite>& group, const absl::Status& room) {
  absl::StatusOr<Results> results = ApplyAll(group, room);
  if (!results.ok()) return results;
  bool changed = std::any_of(results->begin(), results->end(),
                             [](const absl::Status& one) { return one.ok(); });
  // While the store lives on its reserve, a deletion comes first, alone.
  if (ChoresAreDue() && (group.empty() || !lives_on_reserve_)) {
    const absl::StatusOr<bool> done =
        DoChores(/*has_time=*/group.empty(), /*has_room=*/room.ok());
    if (!done.ok()) return done.status();
    changed |= *done;
  }
  absl::Status status =
      changed ? CommitChange() : database_->Prepare("COMMIT").Run();
  if (!status.ok()) return status;
  space_.NoteWrite(/*found_full=*/false);
  Count(group, *results);
  CopyLogIfDue(room);
  return results;
}

absl::Status SqliteWriter::CommitChange() {
  const StoreState next = NextState(state_, run_, /*is_closed=*/false);
  absl::Status status = WriteState(*database_, next);
  if (!status.ok()) return status;
  const Clock::time_point flush = Clock::now();
  status = database_->Prepare("COMMIT").Run();
  if (!status.ok()) return status;
  flush_seconds_.Observe(Clock::now() - flush);
  status = watch_.Check();
  if (!status.ok()) {
    GiveUp(status);
    return status;
  }
  NoteCommit(next);
  return absl::OkStatus();
}

void SqliteWriter::CopyLogIfDue(const absl::Status& room) {
  const bool is_due = chores_ == Chores::kNone
                          ? gave_pages_ || !room.ok()
                          : !room.ok() && !lives_on_reserve_;
  if (is_due) {
    // Copying makes the file shorter, and lets the log be written over.
    CheckCopied(database_->CopyLog().status());
    gave_pages_ = false;
    lives_on_reserve_ = false;
  }
  CheckCopied(database_->copy_failure());
}

absl::Status SqliteWriter::NoteFailure(const absl::Status& cause) {
  next_sequences_.clear();
  lives_on_reserve_ = false;
  // Without a delay a full disk would be tried again and again.
  chores_due_ = Clock::now() + kChoresDelay;
  if (IsFailedFlush(cause)) GiveUp(cause);
  const bool is_full = IsStorageFull(cause);
  if (is_full) space_.NoteWrite(/*found_full=*/true);
  if (!given_up_.ok()) return given_up_;
  const std::string message =
      "nothing was written: " + std::string(cause.message());
  if (is_full) return StorageFull(message);
  return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
}

bool SqliteWriter::TakeReserve() {
  if (!GiveUpReserve(path_)) return false;
  gave_up_reserve_ = true;
  lives_on_reserve_ = true;
  chores_due_ = Clock::now();
  return true;
}

absl::StatusOr<bool> SqliteWriter::DoChores(bool has_time, bool has_room) {
  if (chores_ == Chores::kPurge) {
    const absl::StatusOr<bool> more = PurgeSome(
        *database_, has_room ? kPurgedBatches : kPurgedBatchesWithoutRoom);
    if (!more.ok()) return more;
    if (!*more) chores_ = Chores::kShrink;
    return *more;
  }
  // Giving back moves pages, which takes longer than the waiting writes.
  if (!has_time && has_room) return false;
  const absl::StatusOr<std::int64_t> given =
      has_room ? GiveBackPages(*database_, kKeptPages, kGivenPages)
               : GiveBackPages(*database_, 0, kGivenPagesWithoutRoom);
  if (!given.ok()) return given.status();
  if (*given == 0) {
    chores_ = Chores::kNone;
  } else {
    gave_pages_ = true;
  }
  return *given > 0;
}

void SqliteWriter::NoteCommit(const StoreState& state) {
  const bool is_first = state_.run != run_;
  state_ = state;
  mark_->Write(state_);
  if (is_first) lock_->Write(state_);
}

void SqliteWriter::CheckCopied(const absl::Status& copied) {
  if (IsFailedFlush(copied)) GiveUp(copied);
}

std::int64_t SqliteWriter::FreeBytesInside() {
  if (database_ == nullptr) return 0;
  const absl::StatusOr<std::int64_t> pages =
      database_->QueryInteger("PRAGMA freelist_count");
  const absl::StatusOr<std::int64_t> page_bytes =
      database_->QueryInteger("PRAGMA page_size");
  return pages.ok() && page_bytes.ok() ? *pages * *page_bytes : 0;
}

void SqliteWriter::Close() {
  if (!EnsureDatabase().ok() || !watch_.Check().ok()) return;
  if (!state_.is_closed) {
    const StoreState closed = NextState(state_, run_, /*is_closed=*/true);
    absl::Status status = database_->Prepare("BEGIN IMMEDIATE").Run();
    if (status.ok()) status = WriteState(*database_, closed);
    if (status.ok()) status = database_->Prepare("COMMIT").Run();
    if (!status.ok()) return;
    NoteCommit(closed);
    lock_->Write(closed);
  }
  const absl::StatusOr<bool> copied = database_->CopyLog();
  if (copied.ok() && *copied && mark_->Flush(state_).ok()) {
    database_->KeepLogOnClose(false);
  }
}

void SqliteWriter::Count(const std::vector<PendingWrite>& group,
                         const Results& results) {
  std::uint64_t writes = 0;
  for (std::size_t i = 0; i < group.size(); ++i) {
    if (results[i].ok()) writes += group[i].done.size();
  }
  if (writes > 0) ++commits_;
  writes_ += writes;
}

void SqliteWriter::GiveUp(const absl::Status& cause) {
  if (!given_up_.ok()) return;
  given_up_ = Error(StatusCode::kUnavailable, ReasonOf(cause),
                    std::string("the store takes no more writes, since ") +
                        (IsFailedFlush(cause) ? "a flush failed: " : "") +
                        std::string(cause.message()));
  chores_ = Chores::kNone;
  if (options_.on_failure) options_.on_failure(given_up_);
}

absl::StatusOr<SqliteWriter::Results> SqliteWriter::ApplyAll(
    const std::vector<PendingWrite>& group, const absl::Status& room) {
  // Rows are inserted without a savepoint each, which costs more than the
  // insertion. If one of them damages the transaction, which happens only
  // with a damaged file or a full disk, all is begun again with savepoints.
  absl::StatusOr<std::optional<Results>> results =
      Apply(group, room, Savepoints::kForChanges);
  if (results.ok() && !results->has_value()) {
    next_sequences_.clear();
    absl::Status status = database_->Prepare("ROLLBACK").Run();
    if (status.ok()) status = database_->Prepare("BEGIN IMMEDIATE").Run();
    if (!status.ok()) return status;
    results = Apply(group, room, Savepoints::kForAll);
  }
  if (!results.ok()) return results.status();
  return **std::move(results);
}

absl::StatusOr<std::optional<SqliteWriter::Results>> SqliteWriter::Apply(
    const std::vector<PendingWrite>& group, const absl::Status& room,
    Savepoints savepoints) {
  Results results;
  for (const PendingWrite& write : group) {
    absl::Status result;
    absl::Status status;
    if (!room.ok() && write.need == Need::kRoom) {
      // Nothing was touched: the vehicle's next sequence is as it was.
      result = room;
    } else if (write.apply || savepoints == Savepoints::kForAll) {
      status = ApplyInSavepoint(write, &result);
    } else {
      result = Insert(write.key, write.rows.front());
      if (EndsTransaction(result)) {
        status = result;
      } else if (!LeavesOthersSound(result)) {
        return std::nullopt;
      }
    }
    if (!status.ok()) return status;
    results.push_back(std::move(result));
  }
  return results;
}

// SQLite gives up the whole transaction after some errors.
bool SqliteWriter::EndsTransaction(const absl::Status& result) const {
  return result.code() == StatusCode::kUnavailable ||
         !database_->InTransaction();
}

absl::Status SqliteWriter::Insert(VehicleKey key, const BatchRecord& batch) {
  if (next_sequences_.size() >= kMaxKnownSequences) next_sequences_.clear();
  std::uint64_t& next = next_sequences_[key];
  const absl::Status status = InsertBatch(*database_, key, batch, &next);
  // A refused write is rolled back, so `next` may be wrong.
  if (!status.ok()) next_sequences_.erase(key);
  return status;
}

absl::Status SqliteWriter::ApplyInSavepoint(const PendingWrite& write,
                                            absl::Status* result) {
  absl::Status status = database_->Prepare("SAVEPOINT one").Run();
  if (!status.ok()) return status;
  *result = write.apply ? write.apply() : Insert(write.key, write.rows.front());
  if (EndsTransaction(*result)) return *result;
  if (!result->ok()) {
    next_sequences_.clear();
    status = database_->Prepare("ROLLBACK TO one").Run();
    if (!status.ok()) return status;
  }
  return database_->Prepare("RELEASE one").Run();
}

absl::Status SqliteWriter::EnsureDatabase() {
  if (!given_up_.ok()) return given_up_;
  if (database_ != nullptr) return absl::OkStatus();
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
  database_ = std::move(opened->database);
  state_ = opened->state;
  return absl::OkStatus();
}

}  // namespace revisit::server
