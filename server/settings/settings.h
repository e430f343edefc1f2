// The settings of the server: given by flags, by the environment, by a file.
// Flags win over the environment, the environment over the file, the file over
// defaults.
#ifndef REVISIT_SERVER_SETTINGS_SETTINGS_H_
#define REVISIT_SERVER_SETTINGS_SETTINGS_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/security/client_certificates.h"
#include "server/settings/limits.h"

namespace revisit::server {

// How the server starts if the write-ahead log is damaged.
enum class DamagedLog {
  // The server does not start.
  kRefuse,
  // The server goes on without the part that can no longer be read: an
  // operator's decision.
  kDrop,
};

// How one is added: docs/how-it-works.md. The flag --port-file is the key
// `port-file` of the file and the variable REVISIT_PORT_FILE of the
// environment.
struct ServerSettings {
  // HOST:PORT, or unix:PATH. Port 0 takes a free one.
  std::string listen = "127.0.0.1:50051";
  // A directory, created if missing, that holds the store; or the store's file
  // itself, if the path is that of a file; or postgresql://..., a database that
  // several servers share.
  std::string store = "revisit-store";
  // Whether the store goes with the server, for what nobody needs afterwards.
  // Its directory is made by the server and must not exist before.
  bool temporary_store = false;
  // The address by which the servers of a shared store name this one; empty:
  // `listen`.
  std::string advertise_address;
  // Connections that write to a shared store; reads have others, as many as
  // read at a time. Range [1, 16].
  int store_connections = 2;
  // Whether to write only where a shared store replicates what it acknowledges.
  bool require_replicated = false;
  // How long this server may be out of touch with a shared store before others
  // take its vehicles. Range [1, 3600].
  double lease_seconds = 10.0;
  // How long a start, or a task, waits for a shared store that cannot be opened
  // at the moment; 0 does not wait. Range [0, 86400].
  double store_wait_seconds = 30.0;
  // Writes are refused while the file system of the store has less than this
  // left; they are taken again from a quarter more on. 0 never refuses them.
  // Range [0, 2^50].
  std::int64_t min_free_bytes = std::int64_t{128} << 20;
  // Stores up to this size are checked for damage of their structure before
  // they are served. Range [0, 2^50].
  std::int64_t max_checked_bytes = std::int64_t{256} << 20;
  DamagedLog damaged_log = DamagedLog::kRefuse;
  // HOST:PORT of metrics and probes over HTTP, in plaintext and for everybody
  // who reaches it; port 0 takes a free one. Empty: none.
  std::string admin_listen;
  // If not empty, the address listened on is written here once calls are taken.
  std::string port_file;
  // Whether the end of the standard input ends the server as SIGTERM does: a
  // program that starts a server for itself holds the other end of a pipe,
  // which goes with it however it ends.
  bool end_with_input = false;

  // Threads for the vehicles' short work, such as acknowledging poses; 0 means
  // as many as the machine has processors. Range [0, 1024].
  int worker_threads = 0;
  // Threads for searches; 0 means as many as the machine has processors, but at
  // least 2. Loading and long reads of the store have threads of their own,
  // whose number is not a setting. Range [0, 1024].
  int search_threads = 0;
  // A vehicle that had no call for this long is unloaded. Range [0.01, 1e6].
  double idle_unload_minutes = 10.0;
  // Above this many mebibytes of nodes and edges, vehicles that no call or
  // stream holds are unloaded sooner, the longest unused first; 0 sets no
  // limit. Range [0, 2^30].
  std::int64_t memory_budget_mebibytes = 0;
  // Mebibytes that histories may take that are read from the store for searches
  // in groups; 0 means a quarter of Limits::max_memory_bytes. Range [0, 2^30].
  std::int64_t group_memory_mebibytes = 0;
  // After so many poses of a vehicle, its graph is stored as a snapshot, from
  // which it is loaded faster than from its poses; 0 stores none, nor marks
  // (sessions/snapshots.h), and removes that of a vehicle when it is loaded.
  // Range [0, 2^30].
  std::int64_t snapshot_poses = 20'000;
  // How long calls are still taken after SIGTERM while health already says
  // NOT_SERVING. A balancer in front needs that to turn to other servers before
  // this one refuses calls; a server that stands alone would only be back
  // later, so there is none by default. Range [0, 86400].
  double drain_notice_seconds = 0.0;
  // How long calls may go on after that before they are cut. Range [0, 86400].
  double drain_timeout_seconds = 10.0;

  // While many poses come, acknowledgements may be delayed this long for the
  // sake of larger commits; 0 never delays them. Range [0, 1000].
  double ack_latency_target_ms = 2.0;

  Limits limits;

  // PEM files of the listener's certificate, followed by those that issued it,
  // and of its key. Empty: plaintext.
  std::string tls_cert;
  std::string tls_key;
  // PEM file of the authorities that may issue clients' certificates. Empty:
  // clients are asked for none.
  std::string tls_client_ca;
  ClientCertificates tls_client_certs = ClientCertificates::kRequire;
  // Key set (RFC 7517) of the signers of bearer tokens, and the issuer and
  // audience that tokens must name. Empty: tokens are not accepted.
  std::string token_keys;
  std::string token_issuer;
  std::string token_audience;
  // Range [0, 300].
  int token_leeway_seconds = 10;
  // File that says who may do what (security/policy.h). Needed with token_keys
  // or tls_client_ca, and empty without.
  std::string policy;
  // How often the files of this group are checked for changes, and the callers
  // of streams for their permission to go on. Range [0.05, 60].
  double security_check_seconds = 10.0;
  bool serve_health = true;
  bool serve_reflection = true;
  // Accepts the RiskOfListening().
  bool insecure_allow_remote = false;

  LogFormat log_format = LogFormat::kText;
  LogLevel log_level = LogLevel::kInfo;
  // Calls, and searches of streams, that took longer are logged with what the
  // search had to do; 0 logs none. Range [0, 3600].
  double slow_call_seconds = 0.0;
  // If not empty, the file to which is appended who changed what.
  std::string audit_log;
};

// A task on a store besides serving it.
struct StoreTask {
  enum class Kind { kBackup, kVerify, kCompact, kMigrate, kImport };
  Kind kind;
  // File of a backup, or the store that is imported.
  std::string other;
};

// A setting in seconds as a duration.
inline std::chrono::milliseconds Milliseconds(double seconds) {
  return std::chrono::milliseconds(static_cast<std::int64_t>(seconds * 1000.0));
}

// `store_wait_seconds` as a duration.
std::chrono::milliseconds StoreWaitTime(const ServerSettings& settings);

// The harm that anybody who reaches the address could do; empty if it can only
// be reached from this machine, or is encrypted and identifies callers.
std::string RiskOfListening(const ServerSettings& settings);

struct ParsedSettings {
  ServerSettings settings;
  // If set, the task to do instead of serving.
  std::optional<StoreTask> task;
  // If set, the text to print instead of serving: help, version or the settings
  // themselves.
  std::optional<std::string> print;
};

// `arguments` without the program's name; `environment` as NAME=VALUE. Reads
// the file that --config or REVISIT_CONFIG names (settings_file.h).
//
// INVALID_ARGUMENT, with a message for people that names the key and its place,
// for an unknown key, a value that is malformed or out of range, a key that
// stands twice, settings that do not go together, and a listener at risk
// without insecure-allow-remote. What does not go with the store, its engine
// says (storage/engines/engine.h).
absl::StatusOr<ParsedSettings> ParseSettings(
    const std::vector<std::string>& arguments,
    const std::vector<std::string>& environment);

// The process's own environment, as NAME=VALUE.
std::vector<std::string> ProcessEnvironment();

// All settings in the form of the file, which ParseSettings() reads back as the
// same settings.
std::string PrintSettings(const ServerSettings& settings);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_SETTINGS_H_
