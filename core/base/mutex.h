// The locks of server and client: std::mutex with the annotations of clang's
// thread safety analysis, so that code which touches a guarded member without
// holding its mutex does not compile (-Wthread-safety, see CMakeLists.txt). Not
// for headers that callers of the client library include. It lies in core/base
// because that is all that server and client have in common below them; core
// itself has no threads and includes none of this
// (tests/integration/test_layers.py).
//
// ABSL_GUARDED_BY names the mutex that guards a member,
// ABSL_EXCLUSIVE_LOCKS_REQUIRED those that the caller of a function holds. The
// analysis does not know which locks a lambda's caller holds, so waits are
// written as loops, `while (!condition) changed_.Wait(&mutex_);`.
//
// absl::Mutex would not do: thread sanitizer knows the locks of pthreads, but
// not those of a library that was built without it, as Debian's Abseil is.
#ifndef REVISIT_CORE_BASE_MUTEX_H_
#define REVISIT_CORE_BASE_MUTEX_H_

#include <chrono>
#include <condition_variable>
#include <mutex>

#include "absl/base/thread_annotations.h"

namespace revisit {

class ABSL_LOCKABLE Mutex {
 public:
  Mutex() = default;
  Mutex(const Mutex&) = delete;
  Mutex& operator=(const Mutex&) = delete;

  void Lock() ABSL_EXCLUSIVE_LOCK_FUNCTION() { mutex_.lock(); }
  void Unlock() ABSL_UNLOCK_FUNCTION() { mutex_.unlock(); }

 private:
  friend class CondVar;

  std::mutex mutex_;
};

// Holds a mutex until the end of its block. In between, Unlock() releases it
// and Lock() acquires it again.
class ABSL_SCOPED_LOCKABLE MutexLock {
 public:
  explicit MutexLock(Mutex* mutex) ABSL_EXCLUSIVE_LOCK_FUNCTION(mutex)
      : mutex_(mutex) {
    mutex_->Lock();
  }
  ~MutexLock() ABSL_UNLOCK_FUNCTION() {
    if (holds_) mutex_->Unlock();
  }

  MutexLock(const MutexLock&) = delete;
  MutexLock& operator=(const MutexLock&) = delete;

  // REQUIRES: this does not hold the mutex.
  void Lock() ABSL_EXCLUSIVE_LOCK_FUNCTION() {
    mutex_->Lock();
    holds_ = true;
  }
  // REQUIRES: this holds the mutex.
  void Unlock() ABSL_UNLOCK_FUNCTION() {
    holds_ = false;
    mutex_->Unlock();
  }

 private:
  Mutex* const mutex_;
  bool holds_ = true;
};

// Waits may end without a notification: check the condition again.
class CondVar {
 public:
  CondVar() = default;
  CondVar(const CondVar&) = delete;
  CondVar& operator=(const CondVar&) = delete;

  void NotifyOne() { condition_.notify_one(); }
  void NotifyAll() { condition_.notify_all(); }

  void Wait(Mutex* mutex) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    std::unique_lock<std::mutex> lock(mutex->mutex_, std::adopt_lock);
    condition_.wait(lock);
    lock.release();
  }

  // Returns whether the time has come.
  bool WaitUntil(Mutex* mutex, std::chrono::steady_clock::time_point time)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    std::unique_lock<std::mutex> lock(mutex->mutex_, std::adopt_lock);
    const std::cv_status status = condition_.wait_until(lock, time);
    lock.release();
    return status == std::cv_status::timeout;
  }

 private:
  std::condition_variable condition_;
};

}  // namespace revisit

#endif  // REVISIT_CORE_BASE_MUTEX_H_
