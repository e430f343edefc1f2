// Something that is done again and again.
#ifndef REVISIT_SERVER_BASE_PERIODIC_H_
#define REVISIT_SERVER_BASE_PERIODIC_H_

#include <chrono>
#include <functional>
#include <thread>

#include "core/base/mutex.h"

namespace revisit::server {

// Calls `work` every `period`, the first time after one, on a thread of its
// own, until it is destroyed. Thread-safe.
class Periodic {
 public:
  Periodic(std::chrono::milliseconds period, std::function<void()> work);
  ~Periodic();

  Periodic(const Periodic&) = delete;
  Periodic& operator=(const Periodic&) = delete;

  // Has `work` called as soon as its thread is free, and then a period later.
  void Hasten();

 private:
  void Run();

  const std::chrono::milliseconds period_;
  const std::function<void()> work_;
  Mutex mutex_;
  CondVar wake_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  bool hastened_ ABSL_GUARDED_BY(mutex_) = false;
  // Last: it uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_PERIODIC_H_
