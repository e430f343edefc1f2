// revisitd: reads its settings, serves until told to stop, and drains.
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <sys/eventfd.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <initializer_list>
#include <memory>
#include <optional>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "absl/synchronization/mutex.h"
#include "server/base/line_writer.h"
#include "server/base/logging.h"
#include "server/base/service_manager.h"
#include "server/server.h"
#include "server/settings/settings.h"
#include "server/storage/engines/engine.h"
#include "server/storage/engines/store_tasks.h"

namespace {

using revisit::server::Log;
using revisit::server::LogLevel;
using revisit::server::RevisitServer;
using revisit::server::Watchdog;

using Clock = std::chrono::steady_clock;

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

// Waits for so long at most; 0 if no signal came.
int WaitFor(const sigset_t& signals, Clock::duration limit) {
  const auto deadline = Clock::now() + limit;
  for (;;) {
    const auto left = std::max<std::chrono::nanoseconds>(
        deadline - Clock::now(), std::chrono::nanoseconds(0));
    timespec timeout{};
    timeout.tv_sec = left / std::chrono::seconds(1);
    timeout.tv_nsec = (left % std::chrono::seconds(1)).count();
    const int signal_number = sigtimedwait(&signals, nullptr, &timeout);
    if (signal_number > 0) return signal_number;
    // EINTR: something other than these signals, such as SIGCONT, came.
    if (errno != EINTR) return 0;
  }
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

// Sends the process SIGTERM once its standard input has ended.
class EndWithInput {
 public:
  explicit EndWithInput(const Log* log)
      : log_(log),
        stop_(eventfd(0, EFD_CLOEXEC)),
        thread_([this] { Watch(); }) {}
  ~EndWithInput() {
    eventfd_write(stop_, 1);
    thread_.join();
    close(stop_);
  }

  EndWithInput(const EndWithInput&) = delete;
  EndWithInput& operator=(const EndWithInput&) = delete;

 private:
  void Watch() {
    pollfd files[] = {{STDIN_FILENO, POLLIN, 0}, {stop_, POLLIN, 0}};
    for (;;) {
      if (poll(files, 2, -1) < 0) continue;
      if (files[1].revents != 0) return;
      char ignored[256];
      const ssize_t size = read(STDIN_FILENO, ignored, sizeof(ignored));
      if (size > 0 || (size < 0 && (errno == EINTR || errno == EAGAIN))) {
        continue;
      }
      log_->Write(LogLevel::kInfo, "input_ended", {});
      kill(getpid(), SIGTERM);
      return;
    }
  }

  const Log* const log_;
  const int stop_;
  std::thread thread_;
};

// The directory of a store that goes with the server.
class TemporaryStore {
 public:
  TemporaryStore() = default;
  ~TemporaryStore() {
    if (directory_.empty()) return;
    std::error_code error;
    std::filesystem::remove_all(directory_, error);
  }

  TemporaryStore(const TemporaryStore&) = delete;
  TemporaryStore& operator=(const TemporaryStore&) = delete;

  // Makes it, so that only what came after is ever removed. Returns whether it
  // could be made; errno says why not.
  bool Make(const std::string& directory) {
    if (mkdir(directory.c_str(), 0700) != 0) return false;
    directory_ = directory;
    return true;
  }

 private:
  // Empty if there is nothing to remove.
  std::string directory_;
};

// The level of a log, which people change while the server runs.
class ChangingLevel {
 public:
  ChangingLevel(Log* log, LogLevel configured)
      : log_(log), configured_(configured), level_(configured) {}

  // Goes to the next more detailed level, and from the most detailed one back
  // to that of the settings. Says so in the log, at whichever of the two levels
  // shows more.
  void Next() {
    const LogLevel before = level_;
    level_ = before == LogLevel::kDebug
                 ? configured_
                 : static_cast<LogLevel>(static_cast<int>(before) - 1);
    log_->SetLevel(std::min(before, level_));
    log_->Write(std::min(LogLevel::kError,
                         std::max(LogLevel::kInfo, std::min(before, level_))),
                "log_level", {{"name", revisit::server::NameOf(level_)}});
    log_->SetLevel(level_);
  }

 private:
  Log* const log_;
  const LogLevel configured_;
  LogLevel level_;
};

// Serves until a signal asks for the end, which is returned, or for so long;
// then 0 is. On SIGHUP, the files that may be replaced while the server runs
// are read now. SIGUSR1 is that of log rotation; SIGUSR2 changes the level of
// the log.
int ServeUntilStopped(RevisitServer* server, const Log& log,
                      ChangingLevel* level,
                      std::optional<Clock::duration> limit) {
  const sigset_t signals =
      SetOf({SIGINT, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2, FailureSignal()});
  const auto start = Clock::now();
  for (;;) {
    const int signal = limit ? WaitFor(signals, start + *limit - Clock::now())
                             : WaitFor(signals);
    switch (signal) {
      case SIGHUP:
        log.Write(LogLevel::kInfo, "looking_at_files", {});
        server->LookAtFiles();
        break;
      case SIGUSR1:
        server->ReopenAuditLog();
        break;
      case SIGUSR2:
        level->Next();
        break;
      default:
        return signal;
    }
  }
}

// Serves until the server is to be shut down. It is told that some time before,
// if the settings say so and the server can still do its work.
void Serve(RevisitServer* server, const Log& log, ChangingLevel* level,
           double notice_seconds) {
  const Watchdog watchdog(
      [server](std::chrono::milliseconds patience) {
        return server->Answers(patience);
      },
      &log);
  revisit::server::ReportReady();
  const int signal = ServeUntilStopped(server, log, level, std::nullopt);
  revisit::server::ReportStopping();
  if (signal == FailureSignal() || notice_seconds <= 0.0) return;
  server->GiveNotice();
  ServeUntilStopped(server, log, level,
                    std::chrono::duration_cast<Clock::duration>(
                        std::chrono::duration<double>(notice_seconds)));
}

void Complain(const std::string& message) {
  revisit::server::WriteWithin(STDERR_FILENO, "revisitd: " + message + "\n",
                               kPatience);
}

int ComplainOfSettings(const absl::Status& problem) {
  Complain(std::string(problem.message()) + "\nTry: revisitd --help");
  return revisit::server::kExitUsage;
}

// Says where calls are taken, for a script that waits for it.
void SayAddresses(const RevisitServer& server) {
  std::string addresses;
  if (const std::string admin = server.admin_address(); !admin.empty()) {
    addresses = "admin listening on " + admin + "\n";
  }
  revisit::server::WriteWithin(
      STDOUT_FILENO, addresses + "listening on " + server.address() + "\n",
      kPatience);
}

// Returns the exit code.
int RunServer(const revisit::server::ServerSettings& settings) {
  BlockSignals();
  // Debian builds Abseil with checks for deadlocks, for which each lock looks
  // at all that its thread holds: with 10,000 connections a twentieth of the
  // work.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  Log log(settings.log_format, settings.log_level, STDERR_FILENO);
  revisit::server::StartError error{};
  // Removed once the server, which has files in it, is gone.
  TemporaryStore store;
  if (settings.temporary_store && !store.Make(settings.store)) {
    Complain("temporary-store: " + settings.store +
             " cannot be made: " + std::strerror(errno));
    return revisit::server::kExitStoreFailed;
  }
  std::optional<EndWithInput> end_with_input;
  if (settings.end_with_input) end_with_input.emplace(&log);
  std::unique_ptr<RevisitServer> server;
  {
    const StopWhileStarting stop;
    server = RevisitServer::Start(
        settings, &log, [] { kill(getpid(), FailureSignal()); }, &error);
  }
  if (server == nullptr) {
    Complain(error.message);
    return error.exit_code;
  }
  SayAddresses(*server);
  ChangingLevel level(&log, settings.log_level);
  Serve(server.get(), log, &level, settings.drain_notice_seconds);
  server->Shutdown();
  return server->exit_code();
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  const auto parsed = revisit::server::ParseSettings(
      arguments, revisit::server::ProcessEnvironment());
  if (!parsed.ok()) return ComplainOfSettings(parsed.status());
  if (parsed->print) {
    std::fputs(parsed->print->c_str(), stdout);
    return revisit::server::kExitOk;
  }
  if (parsed->task) {
    return revisit::server::RunStoreTask(parsed->settings, *parsed->task);
  }
  const absl::Status fits = revisit::server::EngineOf(parsed->settings.store)
                                .CheckSettings(parsed->settings);
  if (!fits.ok()) return ComplainOfSettings(fits);
  return RunServer(parsed->settings);
}
