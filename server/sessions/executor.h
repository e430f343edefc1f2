// Threads for the vehicles' work, and an order within one vehicle's.
//
// Work that takes long (loading, reading the store at length) has threads of
// its own, and searches have others. However much there is of the one, a thread
// is free for the others and for the short work, such as acknowledging poses,
// of all vehicles but those whose turn it is; the operating system shares the
// processors between them.
#ifndef REVISIT_SERVER_SESSIONS_EXECUTOR_H_
#define REVISIT_SERVER_SESSIONS_EXECUTOR_H_

#include <deque>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/mutex.h"

namespace revisit::server {

// Where tasks run. Thread-safe.
class Lane {
 public:
  virtual ~Lane() = default;

  // `flow`: whose task it is, for a lane that is fair between flows.
  virtual void Post(const std::string& flow, std::function<void()> task) = 0;
};

// A fixed number of threads; who comes first is served first. Thread-safe.
class Executor final : public Lane {
 public:
  // `name` is for tools that list threads; up to 15 characters.
  // REQUIRES: at least one thread.
  Executor(const char* name, int threads);
  explicit Executor(int threads) : Executor("vehicles", threads) {}
  // Runs what was posted, also by tasks that run meanwhile, then joins.
  ~Executor() override;

  Executor(const Executor&) = delete;
  Executor& operator=(const Executor&) = delete;

  void Post(std::function<void()> task);
  void Post(const std::string& /*flow*/, std::function<void()> task) override {
    Post(std::move(task));
  }

 private:
  void Work();

  Mutex mutex_;
  CondVar wake_;
  std::deque<std::function<void()>> tasks_ ABSL_GUARDED_BY(mutex_);
  // Threads that wait for a task.
  int idle_ ABSL_GUARDED_BY(mutex_) = 0;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;

  std::vector<std::thread> threads_;
};

// The kinds of threads. They may be the same.
struct Lanes {
  Lanes(Executor* all) : Lanes(all, all) {}
  Lanes(Executor* for_short_work, Executor* for_all_else)
      : Lanes(for_short_work, for_all_else, for_all_else) {}
  Lanes(Executor* for_short_work, Executor* for_long_work, Lane* for_searches)
      : short_work(for_short_work),
        long_work(for_long_work),
        searches(for_searches) {}

  Executor* short_work;
  Executor* long_work;
  Lane* searches;
};

// Runs tasks one after the other, in the order posted, each in its lane; gives
// the thread back between tasks, after a slice of time, so that other strands
// get their turn. Searches are in no order with other tasks: they wait for
// their turn in their lane beside the strand, so that short work of the strand
// does not wait for the searches of others. Thread-safe. A task may post to its
// own strand, and may drop the last reference to it.
class Strand {
 public:
  // The executors must outlive all tasks.
  static std::shared_ptr<Strand> Create(const Lanes& lanes);

  Strand(const Strand&) = delete;
  Strand& operator=(const Strand&) = delete;

  void Post(std::function<void()> task);
  void PostLong(std::function<void()> task);
  // `flow`: whose search it is. A search that finds the strand at work again
  // and again gets its place in the order after all.
  void PostSearch(std::string flow, std::function<void()> task);
  // Whether tasks wait for the one that runs, other than searches in their
  // lane.
  bool IsWanted() const;

  // Runs the task before it returns, on the caller's thread, if nothing of the
  // strand runs or waits; else posts it. For tasks that are short and do not
  // block: it saves them the way to another thread. The caller must hold no
  // lock that the task takes.
  template <typename Task>
  void RunOrPost(Task task) {
    // The task may drop the last reference to the strand.
    const std::shared_ptr<State> state = state_;
    if (!Enter(state.get())) {
      Post(std::move(task));
      return;
    }
    task();
    Leave(state.get());
  }

 private:
  struct State;

  explicit Strand(const Lanes& lanes);

  // Whether the caller's thread is now the strand's, until Leave().
  static bool Enter(State* state);
  static void Leave(State* state);

  const std::shared_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_EXECUTOR_H_
