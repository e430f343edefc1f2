// Threads whose time is shared fairly between flows of tasks.
//
// A task that takes long can let others go first in between: it calls Yield()
// now and then, which stops it while another flow has had less. So a flow with
// much to do delays those with little by no more than the time from one such
// call to the next, however long its tasks are.
#ifndef REVISIT_SERVER_SESSIONS_FAIR_EXECUTOR_H_
#define REVISIT_SERVER_SESSIONS_FAIR_EXECUTOR_H_

#include <chrono>
#include <deque>
#include <functional>
#include <string>
#include <thread>
#include <vector>

#include "core/base/mutex.h"
#include "server/sessions/executor.h"
#include "server/sessions/fair_queue.h"

namespace revisit::server {

// Thread-safe.
class FairExecutor final : public Lane {
 public:
  using Clock = std::chrono::steady_clock;

  // At most `at_a_time` tasks run; those that have stopped for others are not
  // among them. `name` is for tools that list threads; up to 15 characters.
  // REQUIRES: at_a_time >= 1.
  FairExecutor(const char* name, int at_a_time);
  // Runs what was posted, also by tasks that run meanwhile, then joins.
  ~FairExecutor() override;

  FairExecutor(const FairExecutor&) = delete;
  FairExecutor& operator=(const FairExecutor&) = delete;

  // Tasks of one flow begin in the order in which they were posted.
  void Post(const std::string& flow, std::function<void()> task) override;

  // For the task that runs on this thread: stops it while it is the turn of
  // others, and returns for how long that was. Does nothing on other threads
  // than those of a FairExecutor. It costs next to nothing if it was called
  // within the last millisecond. The task must hold no lock that tasks of other
  // flows take.
  static Clock::duration Yield();

 private:
  // A task that has stopped; it lives on the stack of its thread.
  struct Stopped {
    CondVar wake;
    bool may_go_on = false;
  };
  // A task to begin, or one to go on.
  struct Turn {
    std::function<void()> task;
    Stopped* stopped = nullptr;
  };
  // The task that a thread is in.
  struct Running {
    FairExecutor* executor;
    const std::string* flow;
    Clock::time_point charged_until;
  };

  void Work();
  // Lets turns begin or go on while there is room.
  void LetRun() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void ChargeUntil(Clock::time_point now, Running* running)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void YieldTo(Clock::time_point now, Running* running);

  static thread_local Running* running_here_;

  const std::string name_;
  const int at_a_time_;

  Mutex mutex_;
  CondVar wake_;
  CondVar all_done_;
  FairQueue<Turn> queue_ ABSL_GUARDED_BY(mutex_);
  // Tasks whose turn has come, each of which a thread is coming for.
  std::deque<FairQueue<Turn>::Taken> ready_ ABSL_GUARDED_BY(mutex_);
  // Tasks whose turn it is.
  int running_ ABSL_GUARDED_BY(mutex_) = 0;
  // Tasks that have stopped.
  int stopped_ ABSL_GUARDED_BY(mutex_) = 0;
  // Threads that are in no task.
  std::size_t idle_ ABSL_GUARDED_BY(mutex_) = 0;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // Started as they are needed: beside those of the tasks that run, one for
  // each that has stopped.
  std::vector<std::thread> threads_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_FAIR_EXECUTOR_H_
