// Cleans up, or comes to an end, when somebody presses Ctrl-C.
#ifndef REVISIT_CLIENT_TERMINAL_INTERRUPT_GUARD_H_
#define REVISIT_CLIENT_TERMINAL_INTERRUPT_GUARD_H_

#include <csignal>
#include <functional>
#include <thread>
#include <vector>

namespace revisit::client {

// While a guard lives, SIGINT, SIGTERM and SIGHUP run `clean_up` on a thread of
// its own and then end the process with code 130. A signal that was ignored
// before stays ignored. The destructor does not return once a signal has come:
// the process ends meanwhile. A process has at most one guard at a time.
//
// One that goes on (After::kGoOn) runs `clean_up` at the first signal, and
// leaves the end to whoever has the guard; the same signal once more ends the
// process at once.
class InterruptGuard {
 public:
  enum class After { kExit, kGoOn };

  explicit InterruptGuard(std::function<void()> clean_up,
                          After after = After::kExit);
  ~InterruptGuard();

  InterruptGuard(const InterruptGuard&) = delete;
  InterruptGuard& operator=(const InterruptGuard&) = delete;

 private:
  struct Replaced {
    int signal;
    struct sigaction action;
  };

  void Replace(int signal, const struct sigaction& action);
  void Wait();

  const std::function<void()> clean_up_;
  const After after_;
  // The ends for reading and for writing.
  int pipe_[2] = {-1, -1};
  std::vector<Replaced> replaced_;
  std::thread thread_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_INTERRUPT_GUARD_H_
