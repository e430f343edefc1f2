// The connection that writes to a store, with its thread: it commits what waits
// together, and does chores while nothing does; sqlite_storage.h says how.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_WRITER_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_WRITER_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <unordered_map>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/histogram.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/sqlite_options.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_opening.h"
#include "server/storage/sqlite/store_state.h"
#include "server/storage/storage.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

// Thread-safe.
class SqliteWriter {
 public:
  // `opened` is the connection, `run` the number of this process in the state
  // of the store.
  SqliteWriter(std::string path, const SqliteOptions& options,
               std::uint64_t run, std::unique_ptr<StoreLock> lock,
               std::unique_ptr<DurableMark> mark, OpenedWriter opened);
  ~SqliteWriter();

  SqliteWriter(const SqliteWriter&) = delete;
  SqliteWriter& operator=(const SqliteWriter&) = delete;

  // Writes what was submitted, and marks the store as closed in order. The
  // connection stays open: the last one to close removes the log.
  void End();

  // Implements Storage::AppendBatches().
  void Append(VehicleKey key, std::vector<BatchRecord> batches,
              std::optional<std::string> vehicle_payload, Storage::Done done);
  // Makes a change of rows on the writer's thread, within a transaction; it may
  // be called again after it was rolled back. `bytes` is about what it writes.
  using Change = std::function<absl::Status(SqliteDatabase&)>;
  // Passed as `bytes`, it keeps other writes out of the change's transaction.
  static constexpr std::size_t kAlone = std::size_t{1} << 40;
  void Submit(std::size_t bytes, Change change, Storage::Done done,
              PendingWrite::Need need = PendingWrite::Need::kRoom);
  // Called by a change that puts rows out of reach: they are removed while
  // there is nothing better to do.
  void PurgeSoon() { chores_ = Chores::kPurge; }
  // Called by a change after which another sequence may come next.
  void ForgetNextSequence(VehicleKey key) { next_sequences_.erase(key); }

  // Whether the next write is likely to find room.
  bool HasRoom() { return space_.HasRoom(); }
  CommitCounts Counts() const {
    return {commits_, writes_, commit_seconds_.Read(), flush_seconds_.Read()};
  }

 private:
  using Clock = std::chrono::steady_clock;
  using Need = PendingWrite::Need;
  // The outcome of each write of a group, which holds for all appends that it
  // joins.
  using Results = std::vector<absl::Status>;

  // Work for when there is nothing better to do, in this order: removing rows
  // of deleted vehicles, then giving back unused room in the file.
  enum class Chores { kNone, kPurge, kShrink };

  // The writer's thread.
  void Write();
  std::optional<Clock::time_point> ChoresDue() const;
  bool ChoresAreDue() const;
  // Commits a group, or refuses it for want of room.
  Results CommitOrRefuse(const std::vector<PendingWrite>& group);
  // Whether the group or the chores leave more room than there was.
  bool MakesRoom(const std::vector<PendingWrite>& group) const;
  // Commits a group, if need be in the room of the reserve; where that fails,
  // nothing of it is written. While `room` is not OK, it is the outcome of
  // writes that need room.
  Results Commit(const std::vector<PendingWrite>& group, absl::Status room);
  // Commits a group, and chores that are due, in one transaction; an error if
  // that failed. `room` is as above, here and in the steps that follow.
  absl::StatusOr<Results> Transact(const std::vector<PendingWrite>& group,
                                   const absl::Status& room);
  absl::StatusOr<Results> FillAndCommit(const std::vector<PendingWrite>& group,
                                        const absl::Status& room);
  // Applies or refuses each write; an error if the transaction cannot go on.
  absl::StatusOr<Results> ApplyAll(const std::vector<PendingWrite>& group,
                                   const absl::Status& room);
  // Which writes get a savepoint, to which the transaction goes back if they
  // are refused: all, or all but appended rows.
  enum class Savepoints { kForAll, kForChanges };
  // Same as ApplyAll(); nothing if a row without a savepoint may have left half
  // of itself in the transaction.
  absl::StatusOr<std::optional<Results>> Apply(
      const std::vector<PendingWrite>& group, const absl::Status& room,
      Savepoints savepoints);
  // Applies one write so that it leaves nothing behind if it is refused. The
  // returned status is not OK if the transaction cannot go on.
  absl::Status ApplyInSavepoint(const PendingWrite& write,
                                absl::Status* result);
  absl::Status Insert(VehicleKey key, const BatchRecord& batch);
  // Whether the transaction is over, or in doubt, after this outcome.
  bool EndsTransaction(const absl::Status& result) const;
  // Commits a transaction that changed something, with the store's new state.
  absl::Status CommitChange();
  void CopyLogIfDue(const absl::Status& room);
  // Call after a transaction that failed; returns what its writes are answered
  // with.
  absl::Status NoteFailure(const absl::Status& cause);
  // Gives up the reserve, for a group or chores that make room; returns
  // whether there was any.
  bool TakeReserve();
  // Does a step of the chores, within a transaction; returns whether it changed
  // anything.
  absl::StatusOr<bool> DoChores(bool has_time, bool has_room);
  // Call after each commit.
  void NoteCommit(const StoreState& state);
  void CheckCopied(const absl::Status& copied);
  // Free bytes in the file itself, as far as SQLite can use them.
  std::int64_t FreeBytesInside();
  // Ends in order: the database alone is the store, and says so. If that cannot
  // be written, the log stays, as after a kill.
  void Close();
  // Counts the writes of a committed transaction.
  void Count(const std::vector<PendingWrite>& group, const Results& results);
  // Takes no write any more, after a failed flush or if the files are gone; see
  // the header.
  void GiveUp(const absl::Status& cause);
  absl::Status EnsureDatabase();

  const std::string path_;
  const SqliteOptions options_;
  const std::uint64_t run_;
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
  std::unique_ptr<SqliteDatabase> database_;
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

  WriteQueue queue_;
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_WRITER_H_
