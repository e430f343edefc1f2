#include "server/storage/write_queue.h"

#include <utility>

namespace revisit::server {

void WriteQueue::Submit(PendingWrite write) {
  {
    const MutexLock guard(&mutex_);
    // Later appends of any vehicle must not get before this write.
    open_rows_.clear();
    Enqueue(std::move(write));
  }
  wake_.NotifyOne();
}

void WriteQueue::SubmitAppend(PendingWrite append) {
  bool wake;
  {
    const MutexLock guard(&mutex_);
    wake = queue_.empty();
    const auto open = open_rows_.find(append.key);
    if (open != open_rows_.end() && Join(open->second, &append)) {
      ++waiting_writes_;
    } else {
      Enqueue(std::move(append));
      open_rows_[queue_.back().key] = &queue_.back();
    }
    // A writer that is busy looks by itself.
    wake = wake || (gathering_ && waiting_writes_ >= last_group_writes_);
  }
  if (wake) wake_.NotifyOne();
}

void WriteQueue::Enqueue(PendingWrite write) {
  if (queue_.empty()) oldest_submission_ = Clock::now();
  ++waiting_writes_;
  queue_.push_back(std::move(write));
}

// Makes an append part of a row that waits, if it follows and fits.
bool WriteQueue::Join(PendingWrite* waiting, PendingWrite* append) const {
  if (waiting->rows.size() > 1 || append->rows.size() > 1) return false;
  BatchRecord& row = waiting->rows.front();
  const BatchRecord& more = append->rows.front();
  if (append->claim != waiting->claim ||
      more.first_sequence != row.first_sequence + row.count ||
      row.count + more.count > options_.max_joined_poses ||
      waiting->bytes + append->bytes > options_.max_joined_bytes) {
    return false;
  }
  row.payload += more.payload;
  row.count += more.count;
  row.revision = more.revision;
  waiting->bytes += append->bytes;
  waiting->done.push_back(std::move(append->done.front()));
  return true;
}

std::optional<std::vector<PendingWrite>> WriteQueue::Take(
    std::optional<Clock::time_point> chores_due, Clock::duration commit_time) {
  const auto chores_are_due = [&] {
    return chores_due && Clock::now() >= *chores_due;
  };
  const MutexLock lock(&mutex_);
  // Chores that are left when the server stops are for the next start.
  while (!stopping_ && queue_.empty() && !chores_are_due()) {
    if (chores_due) {
      wake_.WaitUntil(&mutex_, *chores_due);
    } else {
      wake_.Wait(&mutex_);
    }
  }
  if (queue_.empty() && stopping_) return std::nullopt;
  Gather(commit_time);
  return TakeGroup();
}

// Waits for more writes, see WriteGroupOptions::latency_target.
void WriteQueue::Gather(Clock::duration commit_time) {
  if (options_.latency_target <= commit_time) return;
  gathering_ = true;
  while (!stopping_ && !queue_.empty() &&
         waiting_writes_ < last_group_writes_) {
    const Clock::time_point latest =
        oldest_submission_ + options_.latency_target - commit_time;
    if (wake_.WaitUntil(&mutex_, latest)) break;
  }
  gathering_ = false;
}

std::vector<PendingWrite> WriteQueue::TakeGroup() {
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
  // Near enough for those that are left behind.
  oldest_submission_ = Clock::now();
  return group;
}

void WriteQueue::Stop() {
  {
    const MutexLock guard(&mutex_);
    stopping_ = true;
  }
  wake_.NotifyOne();
}

}  // namespace revisit::server
