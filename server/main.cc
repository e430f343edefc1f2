// revisitd: reads its settings, serves until told to stop, and drains.
#include <pthread.h>
#include <signal.h>
#include <unistd.h>

#include <cstdio>
#include <memory>
#include <string>
#include <vector>

#include "server/logging.h"
#include "server/server.h"
#include "server/settings.h"
#include "server/store_tasks.h"

namespace {

using revisit::server::Log;
using revisit::server::RevisitServer;

// Before any thread starts, so that all of them inherit it and only sigwait()
// below sees the signals.
sigset_t BlockStopSignals() {
  sigset_t signals;
  sigemptyset(&signals);
  sigaddset(&signals, SIGINT);
  sigaddset(&signals, SIGTERM);
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  // A reader of the log or of standard output may go away.
  signal(SIGPIPE, SIG_IGN);
  return signals;
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  const auto parsed = revisit::server::ParseSettings(
      arguments, revisit::server::ProcessEnvironment());
  if (!parsed.ok()) {
    std::fprintf(stderr, "revisitd: %s\nTry: revisitd --help\n",
                 std::string(parsed.status().message()).c_str());
    return revisit::server::kExitUsage;
  }
  if (parsed->print) {
    std::fputs(parsed->print->c_str(), stdout);
    return revisit::server::kExitOk;
  }
  if (parsed->task) {
    return revisit::server::RunStoreTask(parsed->settings, *parsed->task);
  }
  const sigset_t signals = BlockStopSignals();
  const Log log(parsed->settings.log_format, parsed->settings.log_level);
  revisit::server::StartError error{};
  const auto server = RevisitServer::Start(
      parsed->settings, &log, [] { kill(getpid(), SIGTERM); }, &error);
  if (server == nullptr) {
    std::fprintf(stderr, "revisitd: %s\n", error.message.c_str());
    return error.exit_code;
  }
  std::printf("listening on %s\n", server->address().c_str());
  std::fflush(stdout);
  int signal_number = 0;
  sigwait(&signals, &signal_number);
  server->Shutdown();
  return server->exit_code();
}
