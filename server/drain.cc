#include "server/drain.h"

#include <utility>

#include "server/status.h"

namespace revisit::server {

bool Drain::Enter() {
  const std::lock_guard<std::mutex> lock(mutex_);
  ++calls_;
  return !started_;
}

void Drain::Leave() {
  const std::lock_guard<std::mutex> lock(mutex_);
  // Under the lock: afterwards this may be destroyed.
  if (--calls_ == 0) idle_.notify_all();
}

Drain::WatchId Drain::Watch(std::function<void()> wind_down) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    const WatchId id = next_id_++;
    if (!started_) {
      watchers_.emplace(id, std::move(wind_down));
      return id;
    }
  }
  // Not under the lock: it may call Unwatch().
  wind_down();
  return -1;
}

void Drain::Unwatch(WatchId id) {
  const std::lock_guard<std::mutex> lock(mutex_);
  watchers_.erase(id);
}

void Drain::Start() {
  std::map<WatchId, std::function<void()>> watchers;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    started_ = true;
    watchers.swap(watchers_);
  }
  for (const auto& [id, wind_down] : watchers) wind_down();
}

void Drain::WaitForCalls(std::chrono::steady_clock::time_point deadline) {
  std::unique_lock<std::mutex> lock(mutex_);
  idle_.wait_until(lock, deadline, [this] { return calls_ == 0; });
}

absl::Status Drain::Refusal() {
  return Error(absl::StatusCode::kUnavailable, "SERVER_DRAINING",
               "the server is shutting down; reconnect");
}

}  // namespace revisit::server
