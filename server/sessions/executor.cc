#include "server/sessions/executor.h"

#include <pthread.h>

#include <chrono>
#include <utility>

#include "core/base/mutex.h"

namespace revisit::server {
namespace {

// Longest that a strand goes from task to task before others get their turn:
// little beside the time of a flush, much beside the way through the queue.
constexpr std::chrono::microseconds kSlice{500};
// How often a search finds its strand at work when its turn in the lane comes,
// before it waits in the strand instead, and holds up what comes behind it.
constexpr int kTurnsMissed = 4;

}  // namespace

Executor::Executor(const char* name, int threads) {
  for (int i = 0; i < threads; ++i) {
    threads_.emplace_back([this] { Work(); });
    pthread_setname_np(threads_.back().native_handle(), name);
  }
}

Executor::~Executor() {
  {
    const MutexLock guard(&mutex_);
    stopping_ = true;
  }
  wake_.NotifyAll();
  for (std::thread& thread : threads_) thread.join();
}

void Executor::Post(std::function<void()> task) {
  const MutexLock guard(&mutex_);
  tasks_.push_back(std::move(task));
  // Threads at work look for the next task by themselves. Under the lock, since
  // whoever hears of the task may destroy this.
  if (idle_ > 0) wake_.NotifyOne();
}

void Executor::Work() {
  MutexLock lock(&mutex_);
  while (true) {
    ++idle_;
    while (!stopping_ && tasks_.empty()) wake_.Wait(&mutex_);
    --idle_;
    // A task that still runs elsewhere and posts another comes back here for
    // it.
    if (tasks_.empty()) return;
    std::function<void()> task = std::move(tasks_.front());
    tasks_.pop_front();
    lock.Unlock();
    task();
    // Destroys what the task holds before the lock is taken again.
    task = nullptr;
    lock.Lock();
  }
}

struct Strand::State : std::enable_shared_from_this<Strand::State> {
  // Where a task runs. Tasks that follow each other in one place may run in one
  // turn.
  struct Where {
    Lane* lane = nullptr;
    std::string flow{};

    bool operator==(const Where& other) const {
      return lane == other.lane && flow == other.flow;
    }
  };
  struct Task {
    std::function<void()> run;
    Where where;
    // Only has a search wait in its lane again.
    bool is_search_ahead = false;
  };
  // A search that waits in its lane, beside the strand.
  struct Search {
    std::function<void()> run;
    std::string flow;
    int turns_missed = 0;
  };

  explicit State(const Lanes& strand_lanes) : lanes(strand_lanes) {}

  void Post(Task task) {
    Where where;
    {
      const MutexLock guard(&mutex);
      const bool first = !taken;
      if (first) where = task.where;
      tasks.push_back(std::move(task));
      if (!first) return;
      taken = true;
    }
    Schedule(where);
  }

  void Schedule(const Where& where) {
    where.lane->Post(where.flow, [self = shared_from_this(), where] {
      self->RunSome(where);
    });
  }

  void Await(const std::shared_ptr<Search>& search) {
    lanes.searches->Post(search->flow, [self = shared_from_this(), search] {
      self->TakeTurn(search);
    });
  }

  // The turn of a search has come in its lane.
  void TakeTurn(const std::shared_ptr<Search>& search) {
    {
      const MutexLock guard(&mutex);
      if (taken) {
        if (++search->turns_missed < kTurnsMissed) {
          // It waits once more when what is there now is done.
          ++searches_ahead;
          tasks.push_back({[this, search] { Await(search); },
                           {lanes.short_work},
                           /*is_search_ahead=*/true});
        } else {
          tasks.push_back(
              {std::move(search->run), {lanes.searches, search->flow}});
        }
        return;
      }
      taken = true;
    }
    search->run();
    search->run = nullptr;
    GoOn();
  }

  void RunSome(const Where& where) {
    const auto pause = std::chrono::steady_clock::now() + kSlice;
    Task task;
    do {
      {
        const MutexLock guard(&mutex);
        if (tasks.empty() || !(tasks.front().where == where)) break;
        task = std::move(tasks.front());
        tasks.pop_front();
        if (task.is_search_ahead) --searches_ahead;
      }
      task.run();
      task.run = nullptr;
    } while (std::chrono::steady_clock::now() < pause);
    GoOn();
  }

  // Leaves what waits, if anything, to its lane.
  void GoOn() ABSL_LOCKS_EXCLUDED(mutex) {
    Where where;
    {
      const MutexLock guard(&mutex);
      if (tasks.empty()) {
        taken = false;
        return;
      }
      where = tasks.front().where;
    }
    Schedule(where);
  }

  const Lanes lanes;
  Mutex mutex;
  std::deque<Task> tasks ABSL_GUARDED_BY(mutex);
  // Counts the tasks that only have a search wait again.
  std::size_t searches_ahead ABSL_GUARDED_BY(mutex) = 0;
  // Whether a thread is in a task, or was asked to be.
  bool taken ABSL_GUARDED_BY(mutex) = false;
};

std::shared_ptr<Strand> Strand::Create(const Lanes& lanes) {
  return std::shared_ptr<Strand>(new Strand(lanes));
}

Strand::Strand(const Lanes& lanes) : state_(std::make_shared<State>(lanes)) {}

void Strand::Post(std::function<void()> task) {
  // The task may end, and the strand with it, before this call does.
  const std::shared_ptr<State> state = state_;
  state->Post({std::move(task), {state->lanes.short_work}});
}

void Strand::PostLong(std::function<void()> task) {
  const std::shared_ptr<State> state = state_;
  state->Post({std::move(task), {state->lanes.long_work}});
}

bool Strand::IsWanted() const {
  const MutexLock guard(&state_->mutex);
  return state_->tasks.size() > state_->searches_ahead;
}

void Strand::PostSearch(std::string flow, std::function<void()> task) {
  const std::shared_ptr<State> state = state_;
  state->Await(std::make_shared<State::Search>(
      State::Search{std::move(task), std::move(flow)}));
}

bool Strand::Enter(State* state) {
  const MutexLock guard(&state->mutex);
  if (state->taken) return false;
  state->taken = true;
  return true;
}

void Strand::Leave(State* state) { state->GoOn(); }

}  // namespace revisit::server
