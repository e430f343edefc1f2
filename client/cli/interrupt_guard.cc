#include "client/cli/interrupt_guard.h"

#include <pthread.h>
#include <unistd.h>

#include <utility>

#include "client/cli/console.h"

namespace revisit::client {

InterruptGuard::InterruptGuard(std::function<void()> clean_up)
    : clean_up_(std::move(clean_up)) {
  sigemptyset(&signals_);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
    sigaddset(&signals_, signal);
  }
  pthread_sigmask(SIG_BLOCK, &signals_, &previous_mask_);
  struct sigaction ignore = {};
  ignore.sa_handler = SIG_IGN;
  sigaction(SIGPIPE, &ignore, &previous_pipe_action_);
  thread_ = std::thread([this] { Wait(); });
}

InterruptGuard::~InterruptGuard() {
  stopping_ = true;
  // The signal is blocked, and taken by sigwait().
  // NOLINTNEXTLINE(bugprone-bad-signal-to-kill-thread)
  pthread_kill(thread_.native_handle(), SIGTERM);
  thread_.join();
  sigaction(SIGPIPE, &previous_pipe_action_, nullptr);
  pthread_sigmask(SIG_SETMASK, &previous_mask_, nullptr);
}

void InterruptGuard::Wait() {
  int signal = 0;
  while (sigwait(&signals_, &signal) != 0) {
  }
  if (stopping_) return;
  clean_up_();
  _exit(kExitInterrupted);
}

}  // namespace revisit::client
