// What the server is told on start: by flags, by the environment, by a file.
// Flags win over the environment, the environment over the file, the file over
// defaults.
#ifndef REVISIT_SERVER_SETTINGS_SETTINGS_H_
#define REVISIT_SERVER_SETTINGS_SETTINGS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/security/client_certificates.h"
#include "server/settings/limits.h"

namespace revisit::server {

// What to do at start where the write-ahead log is damaged.
enum class DamagedLog {
  // Do not start.
  kRefuse,
  // Go on without what can no longer be read: an operator's decision.
  kDrop,
};

// To add one: a field here, a line in AddOptions() in the .cc, where it is
// read. The flag --node-budget is the key `node-budget` of the file and the
// variable REVISIT_NODE_BUDGET of the environment.
struct ServerSettings {
  // HOST:PORT, or unix:PATH. Port 0 takes a free one.
  std::string listen = "127.0.0.1:50051";
  // A directory, created if missing, that holds the store; or the store's file
  // itself, if the path is that of a file.
  std::string store = "revisit-store";
  // Writes are refused while the file system of the store has less than this
  // left; they are taken again from a quarter more on. 0 never refuses them.
  // Range [0, 2^50].
  std::int64_t min_free_bytes = std::int64_t{128} << 20;
  // The largest store that is checked for damage of its structure before it is
  // served; larger ones are not. Range [0, 2^50].
  std::int64_t max_checked_bytes = std::int64_t{256} << 20;
  DamagedLog damaged_log = DamagedLog::kRefuse;
  // If not empty, the address listened on is written here once calls are taken.
  std::string port_file;

  // Threads for the vehicles' short work, such as acknowledging poses, and for
  // what takes long: searches, loading, reading the store. 0 takes as many as
  // the machine has processors, of the second at least 2. Range [0, 1024].
  int worker_threads = 0;
  int search_threads = 0;
  // A vehicle nobody has asked for this long is unloaded. Range [0.01, 1e6].
  double idle_unload_minutes = 10.0;
  // Above this many mebibytes of nodes and edges, vehicles that no call or
  // stream holds are unloaded sooner, the longest unused first; 0 takes what it
  // takes. Range [0, 2^30].
  std::int64_t memory_budget_mebibytes = 0;
  // How long calls may go on after SIGTERM before they are cut. Range [0,
  // 86400].
  double drain_timeout_seconds = 10.0;

  // Acknowledgements may take this long for the sake of larger commits, while
  // many come; 0: never. Range [0, 1000].
  double ack_latency_target_ms = 2.0;

  Limits limits;

  // PEM files of the listener's certificate, with those that issued it, and its
  // key. Empty: plaintext.
  std::string tls_cert;
  std::string tls_key;
  // PEM file of who may issue clients' certificates. Empty: not asked for.
  std::string tls_client_ca;
  ClientCertificates tls_client_certs = ClientCertificates::kRequire;
  // Key set (RFC 7517) of who may sign bearer tokens, and what has to stand in
  // them. Empty: no tokens.
  std::string token_keys;
  std::string token_issuer;
  std::string token_audience;
  // Range [0, 300].
  int token_leeway_seconds = 10;
  // Who may do what; see security/policy.h. Needed with token_keys or
  // tls_client_ca, and empty without.
  std::string policy;
  // How often the files of this group are looked at, and streams are asked
  // whether their callers may go on. Range [0.05, 60].
  double security_check_seconds = 10.0;
  bool serve_health = true;
  bool serve_reflection = true;
  // Lets RiskOfListening() be taken.
  bool insecure_allow_remote = false;

  LogFormat log_format = LogFormat::kText;
  LogLevel log_level = LogLevel::kInfo;
};

// What revisitd can do with a store besides serving it.
struct StoreTask {
  enum class Kind { kBackup, kVerify, kCompact };
  Kind kind;
  // File of the backup.
  std::string destination;
};

// What whoever reaches the address could do; empty if it can only be reached
// from this machine, or is encrypted and asks who calls.
std::string RiskOfListening(const ServerSettings& settings);

struct ParsedSettings {
  ServerSettings settings;
  // If set, this is to be done instead of serving.
  std::optional<StoreTask> task;
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
// stands, for an unknown key, a value that is malformed or out of range, a
// key that stands twice, settings that do not go together, and a listener at
// risk without insecure-allow-remote.
absl::StatusOr<ParsedSettings> ParseSettings(
    const std::vector<std::string>& arguments,
    const std::vector<std::string>& environment);

// The process's own environment, as NAME=VALUE.
std::vector<std::string> ProcessEnvironment();

// All settings in the form of the file. ParseSettings() makes the same of it.
std::string PrintSettings(const ServerSettings& settings);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_SETTINGS_H_
