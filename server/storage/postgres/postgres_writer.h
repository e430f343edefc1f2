// One of the connections that write, with its thread: every vehicle is written
// by one of them only, so its writes keep their order.
//
// Rows of batches that wait together are appended in one statement; anything
// else is a statement of its own. After a write that was
// answered with UNAVAILABLE or ABORTED, the claim under which it was submitted
// is forgotten, and all later writes under it are refused.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_WRITER_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_WRITER_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "absl/status/status.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/postgres/postgres_appends.h"
#include "server/storage/postgres/postgres_fence.h"
#include "server/storage/storage.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

// Thread-safe.
class PostgresWriter {
 public:
  struct Options : WriteGroupOptions {
    std::string conninfo;
    // Whether to refuse writes where a commit is not replicated.
    bool require_replicated = false;
    // Whether to begin with the rows that are left of what is gone.
    bool purges_first = false;
    // How often to ask how large the database is, in between writes; never if
    // zero. The database then looks at the size of each of its files.
    std::chrono::milliseconds size_period{0};
  };

  // The ownership outlives the writer.
  PostgresWriter(const Options& options, Ownership* ownership);
  // Waits for what was submitted, unless GiveUp() was called.
  ~PostgresWriter();

  PostgresWriter(const PostgresWriter&) = delete;
  PostgresWriter& operator=(const PostgresWriter&) = delete;

  // Takes no more; what was submitted goes on.
  void Stop();
  // Returns whether all that was submitted is settled by then. REQUIRES:
  // Stop().
  bool AwaitEnd(std::chrono::steady_clock::time_point latest);
  // Answers what is left with UNAVAILABLE, although it may be written.
  void GiveUp() { give_up_ = true; }

  // `batches` and `done` are those of Storage::AppendBatches().
  void Append(VehicleKey key, std::vector<BatchRecord> batches,
              Storage::Done done);
  // Runs `write` on the writer's connection, under the vehicle's claim as of
  // now. `bytes` is about what it writes.
  using Write = std::function<absl::Status(PostgresConnection&, const Fence&)>;
  void Submit(VehicleKey key, std::size_t bytes, Write write,
              Storage::Done done);
  // Removes what a vehicle or a snapshot that is gone has left, while there is
  // nothing better to do. Called by writes.
  void PurgeSoon();

  // Implements Storage::CheckWritable().
  absl::Status CheckWritable() const;
  // Without the time of flushes, which a statement that commits by itself does
  // not tell.
  CommitCounts Counts() const {
    return {commits_, writes_, commit_seconds_.Read()};
  }
  // Bytes of the database when it was last asked; nothing if it did not answer.
  std::optional<std::int64_t> DatabaseBytes() const;

 private:
  using Clock = std::chrono::steady_clock;

  void Run();
  void Commit(const std::vector<PendingWrite>& group);
  // Runs to append, by the statement in which they are: of a vehicle, one in
  // each.
  using Rounds = std::vector<std::vector<AppendRun>>;
  // Appends the runs that were gathered.
  void AppendGathered(Rounds* rounds);
  void AppendRound(const std::vector<AppendRun>& runs);
  void Answer(const PendingWrite& write, const absl::Status& status);
  absl::Status Connect();
  // Connects, where that is needed, for a write.
  absl::Status EnsureConnection();
  // OK unless writes have to be replicated, and are not.
  absl::Status CheckReplicated(const Durability& durability) const;
  void Purge();
  void AskSize();
  // When the thread is to do more than to write.
  std::optional<Clock::time_point> NextDue() const;

  const Options options_;
  Ownership* const ownership_;
  std::atomic<bool> give_up_{false};
  std::atomic<std::uint64_t> commits_{0};
  std::atomic<std::uint64_t> writes_{0};
  Histogram commit_seconds_{SecondsBounds()};
  // When a write last found the disk full, since the clock's epoch; 0 if none
  // did since one was written.
  std::atomic<Clock::rep> full_at_{0};
  // -1 while it is not known.
  std::atomic<std::int64_t> database_bytes_{-1};

  WriteQueue queue_;
  // Used by the thread only.
  std::unique_ptr<PostgresConnection> connection_;
  Clock::duration commit_time_{0};
  std::optional<Clock::time_point> purge_due_;
  std::optional<Clock::time_point> size_due_;

  Mutex mutex_;
  CondVar has_ended_;
  bool ended_ ABSL_GUARDED_BY(mutex_) = false;
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_WRITER_H_
