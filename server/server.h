// The server as a whole, which main() starts and stops.
#ifndef REVISIT_SERVER_SERVER_H_
#define REVISIT_SERVER_SERVER_H_

#include <chrono>
#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/exit_code.h"
#include "server/base/logging.h"
#include "server/settings/settings.h"

namespace revisit::server {

struct StartError {
  ExitCode exit_code;
  std::string message;
};

class RevisitServer {
 public:
  // Opens the store and takes calls. Returns null, with `*error` set, if that
  // fails. The log must outlive the server. `on_failure` is called, once and on
  // any thread, if the server can no longer do its work: shut it down then.
  static std::unique_ptr<RevisitServer> Start(const ServerSettings& settings,
                                              const Log* log,
                                              std::function<void()> on_failure,
                                              StartError* error);
  // Shuts down if that was not done.
  ~RevisitServer();

  RevisitServer(const RevisitServer&) = delete;
  RevisitServer& operator=(const RevisitServer&) = delete;

  // The address at which calls are taken, with the port that was chosen.
  const std::string& address() const;

  // The address of metrics and probes; empty if there is none.
  std::string admin_address() const;

  // Has the files that may be replaced while the server runs read now, rather
  // than within ServerSettings::security_check_seconds. Returns at once.
  void LookAtFiles();

  // Opens the log of changes again, for those who have renamed its file.
  void ReopenAuditLog();

  // Whether the server still answers, within `patience` (admin/self_check.h).
  // REQUIRES: Shutdown() is not under way, and no other call of this is.
  bool Answers(std::chrono::milliseconds patience);

  // Has health say NOT_SERVING from now on, while everything else goes on, so
  // that balancers send new calls elsewhere before Shutdown().
  void GiveNotice();

  // Drains: health says NOT_SERVING, new calls are refused, streams send
  // their last acknowledgements and end with UNAVAILABLE (SERVER_DRAINING).
  // Calls that outlast ServerSettings::drain_timeout_seconds are cut. Then the
  // store is closed.
  void Shutdown();

  // The exit code of the process after Shutdown().
  ExitCode exit_code() const;

 private:
  struct State;
  explicit RevisitServer(std::unique_ptr<State> state);
  std::unique_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVER_H_
