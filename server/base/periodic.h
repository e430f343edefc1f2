// Work that is repeated on a thread of its own.
#ifndef REVISIT_SERVER_BASE_PERIODIC_H_
#define REVISIT_SERVER_BASE_PERIODIC_H_

#include <chrono>
#include <functional>
#include <thread>

#include "core/base/mutex.h"

namespace revisit::server {

// Calls `work` every `period`, the first time after one period, until it is
// destroyed. Thread-safe.
class Periodic {
 public:
  Periodic(std::chrono::milliseconds period, std::function<void()> work);
  ~Periodic();

  Periodic(const Periodic&) = delete;
  Periodic& operator=(const Periodic&) = delete;

  // Has `work` called as soon as the thread is free, and the next time a period
  // later.
  void Hasten();

 private:
  void Run();

  const std::chrono::milliseconds period_;
  const std::function<void()> work_;
  Mutex mutex_;
  CondVar wake_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  bool hastened_ ABSL_GUARDED_BY(mutex_) = false;
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_PERIODIC_H_
