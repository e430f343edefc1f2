#include "client/terminal/interrupt_guard.h"

#include <fcntl.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <utility>

#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

constexpr char kInterrupted = 'i';
constexpr char kOver = 'o';

// Where the guard's pipe is written to.
std::atomic<int> interrupts{-1};

void Send(int descriptor, char byte) {
  while (write(descriptor, &byte, 1) < 0 && errno == EINTR) {
  }
}

// Whichever thread the signal comes to.
void OnSignal(int) {
  const int error = errno;
  Send(interrupts, kInterrupted);
  errno = error;
}

}  // namespace

InterruptGuard::InterruptGuard(std::function<void()> clean_up, After after)
    : clean_up_(std::move(clean_up)), after_(after) {
  // Without a pipe, signals keep their meaning.
  if (pipe2(pipe_, O_CLOEXEC) != 0) return;
  interrupts = pipe_[1];
  thread_ = std::thread([this] { Wait(); });
  struct sigaction act = {};
  act.sa_handler = &OnSignal;
  act.sa_flags = SA_RESTART;
  if (after_ == After::kGoOn) act.sa_flags |= SA_RESETHAND;
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) Replace(signal, act);
  struct sigaction ignore = {};
  ignore.sa_handler = SIG_IGN;
  Replace(SIGPIPE, ignore);
}

InterruptGuard::~InterruptGuard() {
  if (!thread_.joinable()) return;
  for (const Replaced& replaced : replaced_) {
    sigaction(replaced.signal, &replaced.action, nullptr);
  }
  Send(pipe_[1], kOver);
  thread_.join();
  interrupts = -1;
  close(pipe_[0]);
  close(pipe_[1]);
}

void InterruptGuard::Replace(int signal, const struct sigaction& action) {
  struct sigaction before = {};
  sigaction(signal, nullptr, &before);
  if (before.sa_handler == SIG_IGN) return;
  sigaction(signal, &action, nullptr);
  replaced_.push_back({signal, before});
}

void InterruptGuard::Wait() {
  char byte = kOver;
  while (read(pipe_[0], &byte, 1) < 0 && errno == EINTR) {
  }
  if (byte == kOver) return;
  clean_up_();
  if (after_ == After::kExit) _exit(kExitInterrupted);
}

}  // namespace revisit::client
