// Cleans up when somebody presses Ctrl-C.
#ifndef REVISIT_CLIENT_CLI_INTERRUPT_GUARD_H_
#define REVISIT_CLIENT_CLI_INTERRUPT_GUARD_H_

#include <atomic>
#include <csignal>
#include <functional>
#include <thread>

namespace revisit::client {

// While a guard lives, SIGINT, SIGTERM and SIGHUP run `clean_up` on a thread of
// its own and then end the process with code 130. Threads that were started
// before it can still take the signals themselves, so make it before any are
// started. A process has at most one guard at a time.
class InterruptGuard {
 public:
  explicit InterruptGuard(std::function<void()> clean_up);
  ~InterruptGuard();

  InterruptGuard(const InterruptGuard&) = delete;
  InterruptGuard& operator=(const InterruptGuard&) = delete;

 private:
  void Wait();

  const std::function<void()> clean_up_;
  sigset_t signals_;
  sigset_t previous_mask_;
  struct sigaction previous_pipe_action_;
  std::atomic<bool> stopping_{false};
  std::thread thread_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_INTERRUPT_GUARD_H_
