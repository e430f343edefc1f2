// Work under way that has to be over before what it uses goes.
#ifndef REVISIT_SERVER_FLEET_TASKS_H_
#define REVISIT_SERVER_FLEET_TASKS_H_

#include <functional>
#include <memory>
#include <utility>

#include "core/base/mutex.h"
#include "server/sessions/executor.h"

namespace revisit::server {

// Thread-safe.
class Tasks {
 public:
  // The executor must outlive this.
  explicit Tasks(Executor* executor) : executor_(executor) {}

  // While somebody holds one, End() waits. A task captures its hold first,
  // since captures go in reverse: what it keeps alive may still use what End()
  // lets go.
  using Hold = std::shared_ptr<void>;
  Hold Begin() ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    ++count_;
    return {this, [](void* tasks) { static_cast<Tasks*>(tasks)->Ended(); }};
  }
  void Post(std::function<void()> task) {
    executor_->Post([hold = Begin(), task = std::move(task)] { task(); });
  }
  // Whether work that takes long is to end early.
  bool is_ending() const ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    return is_ending_;
  }
  // Waits until nothing is under way. Not on a thread of the executor.
  void End() ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    is_ending_ = true;
    while (count_ != 0) over_.Wait(&mutex_);
  }

 private:
  void Ended() ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    // Under the lock: afterwards this may go.
    if (--count_ == 0) over_.NotifyAll();
  }

  Executor* const executor_;
  mutable Mutex mutex_;
  CondVar over_;
  int count_ ABSL_GUARDED_BY(mutex_) = 0;
  bool is_ending_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_TASKS_H_
