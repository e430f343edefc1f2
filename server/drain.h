// Tells long calls that the server is shutting down.
#ifndef REVISIT_SERVER_DRAIN_H_
#define REVISIT_SERVER_DRAIN_H_

#include <cstdint>
#include <functional>
#include <map>
#include <mutex>

#include "absl/status/status.h"

namespace revisit::server {

// Thread-safe.
class Drain {
 public:
  using WatchId = std::int64_t;

  // Calls `wind_down` once when draining starts, or at once if it has started.
  // It may come on any thread, also after Unwatch() was called.
  WatchId Watch(std::function<void()> wind_down);
  void Unwatch(WatchId id);

  void Start();

  // What a call that is cut short answers: UNAVAILABLE (SERVER_DRAINING).
  static absl::Status Refusal();

 private:
  std::mutex mutex_;
  // Guarded by mutex_.
  bool started_ = false;
  WatchId next_id_ = 0;
  std::map<WatchId, std::function<void()>> watchers_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_DRAIN_H_
