#include "server/base/periodic.h"

#include <utility>

namespace revisit::server {

Periodic::Periodic(std::chrono::milliseconds period, std::function<void()> work)
    : period_(period), work_(std::move(work)), thread_([this] { Run(); }) {}

Periodic::~Periodic() {
  {
    const MutexLock lock(&mutex_);
    stopping_ = true;
  }
  wake_.NotifyAll();
  thread_.join();
}

void Periodic::Hasten() {
  {
    const MutexLock lock(&mutex_);
    hastened_ = true;
  }
  wake_.NotifyAll();
}

void Periodic::Run() {
  MutexLock lock(&mutex_);
  while (true) {
    const auto next = std::chrono::steady_clock::now() + period_;
    while (!stopping_ && !hastened_ && !wake_.WaitUntil(&mutex_, next)) {
    }
    if (stopping_) return;
    hastened_ = false;
    lock.Unlock();
    work_();
    lock.Lock();
  }
}

}  // namespace revisit::server
