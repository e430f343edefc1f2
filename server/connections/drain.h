// Counts the calls that are still at work when the server ends, and tells them
// to end: then, and whenever the store is out of reach for so long that nothing
// may be answered.
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
  // How a call is to end.
  struct End {
    absl::Status status;
    // Whether at once: what it waits for may never come. Otherwise once what it
    // has begun is done and answered.
    bool at_once = false;
  };
  using Watcher = std::function<void(const End&)>;

  // Notes that a call begins. Not OK if it is to be refused with this, because
  // it comes too late, or needs the store while that is suspended. Either way,
  // call Leave() when gRPC is done with it.
  absl::Status Enter(bool needs_store);
  void Leave();

  // Calls `wind_down` when draining starts and whenever the store is suspended,
  // or at once if either is so. The call may come on any thread, also after
  // Unwatch() was called.
  WatchId Watch(Watcher wind_down);
  void Unwatch(WatchId id);

  // The store is out of reach, for this reason: calls end with it at once, and
  // others that need the store are refused with it, until Resume().
  void Suspend(const absl::Status& why);
  void Resume();

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
  // OK unless the store is suspended.
  absl::Status suspension_ ABSL_GUARDED_BY(mutex_);
  WatchId next_id_ ABSL_GUARDED_BY(mutex_) = 0;
  std::map<WatchId, Watcher> watchers_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_DRAIN_H_
