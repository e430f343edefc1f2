#include "server/sessions/executor.h"

#include <utility>

namespace revisit::server {

Executor::Executor(int threads) {
  for (int i = 0; i < threads; ++i) {
    threads_.emplace_back([this] { Work(); });
  }
}

Executor::~Executor() {
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

void Executor::Post(std::function<void()> task) {
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    tasks_.push_back(std::move(task));
  }
  wake_.notify_one();
}

void Executor::Work() {
  std::unique_lock<std::mutex> lock(mutex_);
  while (true) {
    wake_.wait(lock, [this] { return stopping_ || !tasks_.empty(); });
    // A task that still runs elsewhere and posts another comes back here for
    // it.
    if (tasks_.empty()) return;
    std::function<void()> task = std::move(tasks_.front());
    tasks_.pop_front();
    lock.unlock();
    task();
    // What the task holds goes before the lock is taken again.
    task = nullptr;
    lock.lock();
  }
}

struct Strand::State : std::enable_shared_from_this<Strand::State> {
  explicit State(Executor* runner) : executor(runner) {}

  void Schedule() {
    executor->Post([self = shared_from_this()] { self->RunOne(); });
  }

  void RunOne() {
    std::function<void()> task;
    {
      const std::lock_guard<std::mutex> guard(mutex);
      task = std::move(tasks.front());
      tasks.pop_front();
    }
    task();
    task = nullptr;
    {
      const std::lock_guard<std::mutex> guard(mutex);
      if (tasks.empty()) {
        scheduled = false;
        return;
      }
    }
    Schedule();
  }

  Executor* const executor;
  std::mutex mutex;
  std::deque<std::function<void()>> tasks;
  // Whether RunOne() is posted or runs.
  bool scheduled = false;
};

std::shared_ptr<Strand> Strand::Create(Executor* executor) {
  return std::shared_ptr<Strand>(new Strand(executor));
}

Strand::Strand(Executor* executor)
    : state_(std::make_shared<State>(executor)) {}

void Strand::Post(std::function<void()> task) {
  // The task may end, and the strand with it, before this call does.
  const std::shared_ptr<State> state = state_;
  {
    const std::lock_guard<std::mutex> guard(state->mutex);
    state->tasks.push_back(std::move(task));
    if (state->scheduled) return;
    state->scheduled = true;
  }
  state->Schedule();
}

}  // namespace revisit::server
