// Writes that wait for the storage's writer, and how they are gathered into
// groups that share a transaction.
#ifndef REVISIT_SERVER_STORAGE_WRITE_QUEUE_H_
#define REVISIT_SERVER_STORAGE_WRITE_QUEUE_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <unordered_map>
#include <vector>

#include "absl/status/status.h"
#include "core/base/mutex.h"
#include "server/storage/records.h"

namespace revisit::server {

struct WriteGroupOptions {
  // Bounds of one transaction. One write may exceed the bytes.
  std::size_t max_group_writes = 1024;
  std::size_t max_group_bytes = std::size_t{8} << 20;
  // Bounds of a row that joins several batches of one vehicle which waited
  // together and follow each other. Their payloads are concatenated, which must
  // make the payload of all their poses, as it does for repeated fields of
  // protobuf. With 0 poses, each batch has a row of its own.
  std::size_t max_joined_poses = 0;
  std::size_t max_joined_bytes = std::size_t{64} << 10;
  // While many writes come, a commit waits until as many wait as the last one
  // held, but only as long as the waiting ones can still be answered within
  // this time of their submission. So a device that flushes fast does not flush
  // for every few writes. With 0, no commit waits.
  std::chrono::microseconds latency_target{0};
};

// One ownership of a vehicle, from when it was taken until it ends.
struct Claim;

// Rows of `batches`, or something else.
struct PendingWrite {
  // How much room a write needs: kLittle is taken even when the disk is short.
  enum class Need { kRoom, kLittle };

  std::size_t bytes = 0;
  // For an append, or several of a vehicle that share a row: rows that follow
  // each other.
  VehicleKey key = 0;
  std::vector<BatchRecord> rows;
  // The ownership of the vehicle under which it was submitted; null where a
  // storage has but one owner.
  std::shared_ptr<const Claim> claim;
  // For something else: may be called again after it was rolled back.
  std::function<absl::Status()> apply;
  // One callback per joined append, or a single one.
  std::vector<WriteDone> done;
  Need need = Need::kRoom;

  // REQUIRES: there are rows.
  std::uint64_t first_sequence() const { return rows.front().first_sequence; }
  std::uint64_t last_sequence() const {
    return rows.back().first_sequence + rows.back().count - 1;
  }
};

// Thread-safe. One thread takes.
class WriteQueue {
 public:
  using Clock = std::chrono::steady_clock;

  explicit WriteQueue(const WriteGroupOptions& options) : options_(options) {}

  void Submit(PendingWrite write);
  // Submits rows, or, if it is but one, makes it part of one of its vehicle
  // that waits.
  void SubmitAppend(PendingWrite append);

  // Waits for writes, or until `chores_due` if given, and takes the next group,
  // oldest first; it is empty where only chores are due. Nothing once Stop()
  // was called and all is taken. `commit_time`: what a commit takes of late.
  std::optional<std::vector<PendingWrite>> Take(
      std::optional<Clock::time_point> chores_due, Clock::duration commit_time);
  void Stop();

 private:
  void Enqueue(PendingWrite write) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool Join(PendingWrite* waiting, PendingWrite* append) const;
  void Gather(Clock::duration commit_time)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::vector<PendingWrite> TakeGroup() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const WriteGroupOptions options_;

  Mutex mutex_;
  CondVar wake_;
  std::deque<PendingWrite> queue_ ABSL_GUARDED_BY(mutex_);
  // For each vehicle, the append in the queue that others may still join.
  std::unordered_map<VehicleKey, PendingWrite*> open_rows_
      ABSL_GUARDED_BY(mutex_);
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // Writes in the queue, each batch of a row counted.
  std::size_t waiting_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  std::size_t last_group_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  // When the first in the queue was submitted, or the last group was taken.
  Clock::time_point oldest_submission_ ABSL_GUARDED_BY(mutex_);
  bool gathering_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_WRITE_QUEUE_H_
