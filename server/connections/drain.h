// Counts the calls that are still at work when the server ends, and notifies
// them.
//
// gRPC's own shutdown is no substitute: it also waits for every idle client to
// hear of it, which may take until its deadline.
#ifndef REVISIT_SERVER_CONNECTIONS_DRAIN_H_
#define REVISIT_SERVER_CONNECTIONS_DRAIN_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>

#include "absl/status/status.h"
#include "core/base/mutex.h"

namespace revisit::server {

// Thread-safe.
class Drain {
 public:
  using WatchId = std::int64_t;

  // Notes that a call begins; false if it comes too late and is to be refused.
  // Either way, call Leave() when gRPC is done with it.
  bool Enter();
  void Leave();

  // Calls `wind_down` once when draining starts, or at once if it has started.
  // The call may come on any thread, also after Unwatch() was called.
  WatchId Watch(std::function<void()> wind_down);
  void Unwatch(WatchId id);

  void Start();
  // Waits until no call is left, or until the deadline.
  void WaitForCalls(std::chrono::steady_clock::time_point deadline);
  // Whether calls were at work when draining started, or began since then:
  // their callers may not have read yet how they ended.
  bool HasEndedCalls() const;

  // The status of a call that is cut short: UNAVAILABLE (SERVER_DRAINING).
  static absl::Status Refusal();

 private:
  mutable Mutex mutex_;
  CondVar idle_;
  std::int64_t calls_ ABSL_GUARDED_BY(mutex_) = 0;
  bool started_ ABSL_GUARDED_BY(mutex_) = false;
  bool has_ended_calls_ ABSL_GUARDED_BY(mutex_) = false;
  WatchId next_id_ ABSL_GUARDED_BY(mutex_) = 0;
  std::map<WatchId, std::function<void()>> watchers_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_DRAIN_H_
