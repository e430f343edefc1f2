#include "server/connections/drain.h"

#include <utility>

#include "server/base/status.h"

namespace revisit::server {

bool Drain::Enter() {
  const MutexLock lock(&mutex_);
  ++calls_;
  has_ended_calls_ = has_ended_calls_ || started_;
  return !started_;
}

void Drain::Leave() {
  const MutexLock lock(&mutex_);
  // Notified under the lock: once it is released, this may be destroyed.
  if (--calls_ == 0) idle_.NotifyAll();
}

Drain::WatchId Drain::Watch(std::function<void()> wind_down) {
  {
    const MutexLock lock(&mutex_);
    const WatchId id = next_id_++;
    if (!started_) {
      watchers_.emplace(id, std::move(wind_down));
      return id;
    }
  }
  // Called without the lock: it may call Unwatch().
  wind_down();
  return -1;
}

void Drain::Unwatch(WatchId id) {
  const MutexLock lock(&mutex_);
  watchers_.erase(id);
}

void Drain::Start() {
  std::map<WatchId, std::function<void()>> watchers;
  {
    const MutexLock lock(&mutex_);
    started_ = true;
    has_ended_calls_ = has_ended_calls_ || calls_ != 0;
    watchers.swap(watchers_);
  }
  for (const auto& [id, wind_down] : watchers) wind_down();
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
