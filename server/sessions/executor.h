// Threads for the vehicles' work, and an order within one vehicle's.
#ifndef REVISIT_SERVER_SESSIONS_EXECUTOR_H_
#define REVISIT_SERVER_SESSIONS_EXECUTOR_H_

#include <condition_variable>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace revisit::server {

// A fixed number of threads. Thread-safe.
class Executor {
 public:
  // REQUIRES: at least one thread.
  explicit Executor(int threads);
  // Runs what was posted, also by tasks that run meanwhile, then joins.
  ~Executor();

  Executor(const Executor&) = delete;
  Executor& operator=(const Executor&) = delete;

  void Post(std::function<void()> task);

 private:
  void Work();

  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::function<void()>> tasks_;
  bool stopping_ = false;

  std::vector<std::thread> threads_;
};

// Runs tasks one after the other, in the order posted, on an executor's
// threads; gives the thread back between tasks so that other strands get their
// turn. Thread-safe. A task may post to its own strand, and may drop the last
// reference to it.
class Strand {
 public:
  // The executor must outlive all tasks.
  static std::shared_ptr<Strand> Create(Executor* executor);

  Strand(const Strand&) = delete;
  Strand& operator=(const Strand&) = delete;

  void Post(std::function<void()> task);

 private:
  struct State;

  explicit Strand(Executor* executor);

  const std::shared_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_EXECUTOR_H_
