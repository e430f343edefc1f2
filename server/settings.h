// What the server is told on start: by flags, by the environment, by a file.
// Flags win over the environment, the environment over the file, the file over
// defaults.
#ifndef REVISIT_SERVER_SETTINGS_H_
#define REVISIT_SERVER_SETTINGS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/limits.h"
#include "server/logging.h"

namespace revisit::server {

// To add one: a field here, a line in AddOptions() in the .cc, where it is
// read. The flag --node-budget is the key `node-budget` of the file and the
// variable REVISIT_NODE_BUDGET of the environment.
struct ServerSettings {
  // HOST:PORT, or unix:PATH. Port 0 takes a free one.
  std::string listen = "127.0.0.1:50051";
  // A directory, created if missing, that holds the store; or the store's file
  // itself, if the path is that of a file.
  std::string store = "revisit-store";
  // If not empty, the address listened on is written here once calls are taken.
  std::string port_file;

  // Threads for the vehicles' work; 0 takes as many as the machine has
  // processors. Range [0, 1024].
  int worker_threads = 0;
  // A vehicle nobody has asked for this long is unloaded. Range [0.01, 1e6].
  double idle_unload_minutes = 10.0;
  // How long calls may go on after SIGTERM before they are cut. Range [0,
  // 86400].
  double drain_timeout_seconds = 10.0;

  Limits limits;

  LogFormat log_format = LogFormat::kText;
  LogLevel log_level = LogLevel::kInfo;
};

struct ParsedSettings {
  ServerSettings settings;
  // If set, this is what was asked for instead of a server: help, version or
  // the settings themselves.
  std::optional<std::string> print;
};

// `arguments` without the program's name; `environment` as NAME=VALUE. Reads
// the file that --config or REVISIT_CONFIG names:
//
//   # A comment has a line of its own.
//   listen = "127.0.0.1:50051"
//   worker-threads = 4
//
// INVALID_ARGUMENT with a message for people that names the key and where it
// stands, for an unknown key, a value that is malformed or out of range, and a
// key that stands twice.
absl::StatusOr<ParsedSettings> ParseSettings(
    const std::vector<std::string>& arguments,
    const std::vector<std::string>& environment);

// The process's own environment, as NAME=VALUE.
std::vector<std::string> ProcessEnvironment();

// All settings in the form of the file. ParseSettings() makes the same of it.
std::string PrintSettings(const ServerSettings& settings);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_H_
