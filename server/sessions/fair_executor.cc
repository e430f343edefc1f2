#include "server/sessions/fair_executor.h"

#include <pthread.h>

#include <optional>
#include <utility>

namespace revisit::server {
namespace {

// How long a task goes on before it asks whether it is the turn of others: much
// beside the change from one thread to another, little beside a search that
// somebody would notice.
constexpr std::chrono::milliseconds kSlice{1};

// How much a flow that has paused may have at once. A flow that asks for less
// in all than its share so rarely stops half way.
constexpr std::chrono::nanoseconds kCredit = std::chrono::milliseconds(50);

// Tasks that may have stopped at a time. Each keeps its thread and what it has
// in memory. A flow has no more of them than may run at a time, so these are
// enough for many flows; beyond them tasks run to their ends.
constexpr int kMostStopped = 30;

}  // namespace

thread_local FairExecutor::Running* FairExecutor::running_here_ = nullptr;

FairExecutor::FairExecutor(const char* name, int at_a_time)
    : name_(name), at_a_time_(at_a_time), queue_(kCredit.count()) {}

FairExecutor::~FairExecutor() {
  std::vector<std::thread> threads;
  {
    const MutexLock lock(&mutex_);
    while (running_ > 0 || stopped_ > 0 || !queue_.empty()) {
      all_done_.Wait(&mutex_);
    }
    stopping_ = true;
    threads.swap(threads_);
  }
  wake_.NotifyAll();
  for (std::thread& thread : threads) thread.join();
}

void FairExecutor::Post(const std::string& flow, std::function<void()> task) {
  const MutexLock lock(&mutex_);
  queue_.Push(flow, {std::move(task), nullptr});
  LetRun();
}

void FairExecutor::LetRun() {
  while (running_ < at_a_time_) {
    std::optional<FairQueue<Turn>::Taken> next = queue_.Take();
    if (!next) return;
    ++running_;
    if (Stopped* const stopped = next->item.stopped) {
      stopped->may_go_on = true;
      stopped->wake.NotifyOne();
      continue;
    }
    ready_.push_back(*std::move(next));
    if (ready_.size() <= idle_) {
      wake_.NotifyOne();
      continue;
    }
    ++idle_;
    threads_.emplace_back([this] { Work(); });
    pthread_setname_np(threads_.back().native_handle(), name_.c_str());
  }
}

void FairExecutor::Work() {
  MutexLock lock(&mutex_);
  while (true) {
    while (!stopping_ && ready_.empty()) wake_.Wait(&mutex_);
    if (ready_.empty()) return;
    --idle_;
    FairQueue<Turn>::Taken turn = std::move(ready_.front());
    ready_.pop_front();
    lock.Unlock();
    Running running{this, &turn.flow, Clock::now()};
    running_here_ = &running;
    turn.item.task();
    // Destroys what the task holds before the lock is taken again.
    turn.item.task = nullptr;
    running_here_ = nullptr;
    const Clock::time_point now = Clock::now();
    lock.Lock();
    ChargeUntil(now, &running);
    queue_.Finish(turn.flow);
    --running_;
    ++idle_;
    LetRun();
    if (running_ == 0) all_done_.NotifyAll();
  }
}

void FairExecutor::ChargeUntil(Clock::time_point now, Running* running) {
  const std::chrono::nanoseconds used = now - running->charged_until;
  queue_.Charge(*running->flow, used.count());
  running->charged_until = now;
}

FairExecutor::Clock::duration FairExecutor::Yield() {
  Running* const running = running_here_;
  if (running == nullptr) return Clock::duration::zero();
  const Clock::time_point now = Clock::now();
  if (now - running->charged_until < kSlice) return Clock::duration::zero();
  running->executor->YieldTo(now, running);
  return running->charged_until - now;
}

// Goes on at `charged_until`.
void FairExecutor::YieldTo(Clock::time_point now, Running* running) {
  const MutexLock lock(&mutex_);
  ChargeUntil(now, running);
  if (stopped_ == kMostStopped || !queue_.OthersFirst(*running->flow)) return;
  Stopped here;
  ++stopped_;
  --running_;
  queue_.Return(*running->flow, {nullptr, &here});
  LetRun();
  while (!here.may_go_on) here.wake.Wait(&mutex_);
  --stopped_;
  running->charged_until = Clock::now();
}

}  // namespace revisit::server
