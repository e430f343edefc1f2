// revisitd: reads its settings, serves until told to stop, and drains.
#include <pthread.h>
#include <signal.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <initializer_list>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "server/base/line_writer.h"
#include "server/base/logging.h"
#include "server/server.h"
#include "server/settings/settings.h"
#include "server/store_tasks.h"

namespace {

using revisit::server::Log;
using revisit::server::LogLevel;
using revisit::server::RevisitServer;

// How long a message may wait for a reader of the standard streams.
constexpr std::chrono::seconds kPatience{1};

// Signals that the process sends to itself: the server can no longer do its
// work; the start is over.
int FailureSignal() { return SIGRTMIN; }
int StartedSignal() { return SIGRTMIN + 1; }

sigset_t SetOf(std::initializer_list<int> signals) {
  sigset_t set;
  sigemptyset(&set);
  for (const int signal : signals) sigaddset(&set, signal);
  return set;
}

int WaitFor(const sigset_t& signals) {
  int signal_number = 0;
  sigwait(&signals, &signal_number);
  return signal_number;
}

// Call before any thread starts, so that all threads inherit the mask and only
// sigwait() sees the signals. SIGQUIT keeps its meaning: it ends the process
// with a core file that shows what it was doing.
void BlockSignals() {
  const sigset_t signals = SetOf({SIGINT, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2,
                                  FailureSignal(), StartedSignal()});
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  // A reader of the log or of standard output may go away.
  signal(SIGPIPE, SIG_IGN);
}

// Ends the process if a signal asks it to stop while it starts, which takes
// long if there is much to check in the store. There is nothing to drain yet,
// and the store withstands the end of the process at any time.
class StopWhileStarting {
 public:
  StopWhileStarting()
      : thread_([] {
          const int signal = WaitFor(SetOf({SIGINT, SIGTERM, StartedSignal()}));
          if (signal != StartedSignal()) std::_Exit(revisit::server::kExitOk);
        }) {}
  ~StopWhileStarting() {
    pthread_kill(thread_.native_handle(), StartedSignal());
    thread_.join();
  }

  StopWhileStarting(const StopWhileStarting&) = delete;
  StopWhileStarting& operator=(const StopWhileStarting&) = delete;

 private:
  std::thread thread_;
};

// Serves until a signal asks for the end. On SIGHUP, the files that may be
// replaced while the server runs are read now. SIGUSR1 and SIGUSR2, by which
// log rotation asks for files to be opened again, have nothing to do here and
// must not end the server.
void ServeUntilStopped(RevisitServer* server, const Log& log) {
  const sigset_t signals =
      SetOf({SIGINT, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2, FailureSignal()});
  for (;;) {
    switch (WaitFor(signals)) {
      case SIGHUP:
        log.Write(LogLevel::kInfo, "looking_at_files", {});
        server->LookAtFiles();
        break;
      case SIGUSR1:
      case SIGUSR2:
        break;
      default:
        return;
    }
  }
}

void Complain(const std::string& message) {
  revisit::server::WriteWithin(STDERR_FILENO, "revisitd: " + message + "\n",
                               kPatience);
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  const auto parsed = revisit::server::ParseSettings(
      arguments, revisit::server::ProcessEnvironment());
  if (!parsed.ok()) {
    Complain(std::string(parsed.status().message()) + "\nTry: revisitd --help");
    return revisit::server::kExitUsage;
  }
  if (parsed->print) {
    std::fputs(parsed->print->c_str(), stdout);
    return revisit::server::kExitOk;
  }
  if (parsed->task) {
    return revisit::server::RunStoreTask(parsed->settings, *parsed->task);
  }
  BlockSignals();
  const Log log(parsed->settings.log_format, parsed->settings.log_level,
                STDERR_FILENO);
  revisit::server::StartError error{};
  std::unique_ptr<RevisitServer> server;
  {
    const StopWhileStarting stop;
    server = RevisitServer::Start(
        parsed->settings, &log, [] { kill(getpid(), FailureSignal()); },
        &error);
  }
  if (server == nullptr) {
    Complain(error.message);
    return error.exit_code;
  }
  revisit::server::WriteWithin(
      STDOUT_FILENO, "listening on " + server->address() + "\n", kPatience);
  ServeUntilStopped(server.get(), log);
  server->Shutdown();
  return server->exit_code();
}
