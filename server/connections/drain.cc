#include "server/connections/drain.h"

#include <utility>

#include "server/base/status.h"

namespace revisit::server {

absl::Status Drain::Enter(bool needs_store) {
  const MutexLock lock(&mutex_);
  ++calls_;
  has_ended_calls_ = has_ended_calls_ || started_;
  if (started_) return Refusal();
  return needs_store ? suspension_ : absl::OkStatus();
}

void Drain::Leave() {
  const MutexLock lock(&mutex_);
  // Notified under the lock: once it is released, this may be destroyed.
  if (--calls_ == 0) idle_.NotifyAll();
}

Drain::WatchId Drain::Watch(Watcher wind_down) {
  WatchId id = -1;
  End end;
  {
    const MutexLock lock(&mutex_);
    if (started_) {
      end = {Refusal()};
    } else {
      id = next_id_++;
      watchers_.emplace(id, wind_down);
      if (suspension_.ok()) return id;
      end = {suspension_, /*at_once=*/true};
    }
  }
  // Called without the lock: it may call Unwatch().
  wind_down(end);
  return id;
}

void Drain::Unwatch(WatchId id) {
  const MutexLock lock(&mutex_);
  watchers_.erase(id);
}

void Drain::Suspend(const absl::Status& why) {
  std::map<WatchId, Watcher> watchers;
  {
    const MutexLock lock(&mutex_);
    suspension_ = why;
    watchers = watchers_;
  }
  const End end = {why, /*at_once=*/true};
  for (const auto& [id, wind_down] : watchers) wind_down(end);
}

void Drain::Resume() {
  const MutexLock lock(&mutex_);
  suspension_ = absl::OkStatus();
}

void Drain::Start() {
  std::map<WatchId, Watcher> watchers;
  {
    const MutexLock lock(&mutex_);
    started_ = true;
    has_ended_calls_ = has_ended_calls_ || calls_ != 0;
    watchers.swap(watchers_);
  }
  const End end = {Refusal()};
  for (const auto& [id, wind_down] : watchers) wind_down(end);
}

void Drain::WaitForCalls(std::chrono::steady_clock::time_point deadline) {
  const MutexLock lock(&mutex_);
  while (calls_ != 0 && !idle_.WaitUntil(&mutex_, deadline)) {
  }
}

bool Drain::HasEndedCalls() const {
  const MutexLock lock(&mutex_);
  return has_ended_calls_;
}

absl::Status Drain::Refusal() {
  return Error(absl::StatusCode::kUnavailable, "SERVER_DRAINING",
               "the server is shutting down; reconnect");
}

}  // namespace revisit::server
