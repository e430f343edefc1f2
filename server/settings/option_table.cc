#include "server/settings/option_table.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <sstream>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/settings/settings_file.h"

namespace revisit::server {
namespace {

// Columns of the descriptions.
constexpr std::size_t kDescriptionColumns = 46;

template <typename T>
using Choices = std::vector<std::pair<std::string, T>>;

const Choices<LogFormat>& LogFormats() {
  static const auto* const choices = new Choices<LogFormat>{
      {"text", LogFormat::kText}, {"json", LogFormat::kJson}};
  return *choices;
}

const Choices<DamagedLog>& DamagedLogs() {
  static const auto* const choices = new Choices<DamagedLog>{
      {"refuse", DamagedLog::kRefuse}, {"drop", DamagedLog::kDrop}};
  return *choices;
}

const Choices<LogLevel>& LogLevels() {
  static const auto* const choices = [] {
    auto* const levels = new Choices<LogLevel>;
    for (const LogLevel level :
         {LogLevel::kDebug, LogLevel::kInfo, LogLevel::kWarning,
          LogLevel::kError, LogLevel::kOff}) {
      levels->emplace_back(NameOf(level), level);
    }
    return levels;
  }();
  return *choices;
}

const Choices<ClientCertificates>& ClientCertificateChoices() {
  static const auto* const choices = new Choices<ClientCertificates>{
      {"require", ClientCertificates::kRequire},
      {"optional", ClientCertificates::kVerifyIfGiven}};
  return *choices;
}

const Choices<bool>& StoredCheckChoices() {
  static const auto* const choices =
      new Choices<bool>{{"stored", true}, {"on-request", false}};
  return *choices;
}

const Choices<bool>& Switch() {
  static const auto* const choices =
      new Choices<bool>{{"on", true}, {"off", false}};
  return *choices;
}

template <typename T>
std::string ChoiceName(const Choices<T>& choices, T value) {
  for (const auto& [name, choice] : choices) {
    if (choice == value) return name;
  }
  return "";
}

// The shortest text that reads back as the same number.
std::string RoundTripText(double value) {
  char text[32];
  for (int digits = 6; digits <= 17; ++digits) {
    std::snprintf(text, sizeof(text), "%.*g", digits, value);
    if (std::strtod(text, nullptr) == value) break;
  }
  return text;
}
std::string RoundTripText(std::int64_t value) { return absl::StrCat(value); }
std::string RoundTripText(int value) { return absl::StrCat(value); }

// Adds the options of one group of the help.
class Group {
 public:
  Group(const char* name, CLI::App* app,
        std::vector<OptionTable::Entry>* entries)
      : name_(name), app_(app), entries_(entries) {}

  void Text(const char* key, std::string* value, const char* type,
            const char* description) {
    Register(key,
             app_->add_option(Flag(key), *value, Wrapped(description))
                 ->type_name(type)
                 ->capture_default_str(),
             [value] { return QuotedValue(*value); });
  }

  // The bounds may be literals of another type than the value.
  template <typename T, typename Lowest, typename Highest>
  void Number(const char* key, T* value, Lowest lowest, Highest highest,
              const char* description) {
    NumberInRange<T>(key, value, static_cast<T>(lowest),
                     static_cast<T>(highest), description);
  }

  template <typename T>
  void Choice(const char* key, const Choices<T>& choices, T* value,
              const char* description) {
    std::string names;
    for (const auto& choice : choices) {
      absl::StrAppend(&names, names.empty() ? "" : "|", choice.first);
    }
    const auto check = [&choices, names](const std::string& text) {
      for (const auto& choice : choices) {
        if (choice.first == text) return std::string();
      }
      return absl::StrCat("got \"", text, "\"; allowed is ", names);
    };
    const auto assign = [&choices, value](const std::string& text) {
      for (const auto& [name, choice] : choices) {
        if (name == text) *value = choice;
      }
    };
    Register(
        key,
        app_->add_option_function<std::string>(Flag(key), assign,
                                               Wrapped(description))
            ->type_name(names)
            ->check(CLI::Validator(check, ""))
            ->default_str(ChoiceName(choices, *value)),
        [&choices, value] { return QuotedValue(ChoiceName(choices, *value)); });
  }

 private:
  static std::string Flag(const char* key) { return absl::StrCat("--", key); }

  void Register(const char* key, CLI::Option* option,
                std::function<std::string()> value_text) {
    option->group(name_);
    entries_->push_back({key, option, std::move(value_text)});
  }

  template <typename T>
  void NumberInRange(const char* key, T* value, T lowest, T highest,
                     const char* description) {
    const auto check = [lowest, highest](const std::string& text) {
      T number{};
      // Written so that not-a-number fails.
      if (CLI::detail::lexical_cast(text, number) && number >= lowest &&
          number <= highest) {
        return std::string();
      }
      return absl::StrCat("got \"", text, "\"; allowed is a number in [",
                          RoundTripText(lowest), ", ", RoundTripText(highest),
                          "]");
    };
    Register(key,
             app_->add_option(Flag(key), *value, Wrapped(description))
                 ->type_name("N")
                 ->check(CLI::Validator(check, ""))
                 ->default_str(RoundTripText(*value)),
             [value] { return RoundTripText(*value); });
  }

  const char* const name_;
  CLI::App* const app_;
  std::vector<OptionTable::Entry>* const entries_;
};

void AddServing(Group add, ServerSettings& s) {
  add.Text("listen", &s.listen, "HOST:PORT",
           "Address at which calls are taken; port 0 takes a free one");
  add.Text(
      "store", &s.store, "PATH",
      "Directory of the store, created if missing; or the store's file, if "
      "that is what the path names; or postgresql://..., a database that "
      "several servers share");
  add.Choice("temporary-store", Switch(), &s.temporary_store,
             "Whether the directory of the store, which must not exist yet, is "
             "removed when the server ends");
  add.Text("advertise-address", &s.advertise_address, "HOST:PORT",
           "Address by which the servers of a shared store name this one; "
           "empty: that of listen");
  add.Number("store-connections", &s.store_connections, 1, 16,
             "Connections that write to a shared store");
  add.Choice("require-replicated", Switch(), &s.require_replicated,
             "Whether to write only where a shared store replicates a commit "
             "before it acknowledges it");
  add.Number("lease-seconds", &s.lease_seconds, 1, 3600,
             "Seconds that this server may be out of touch with a shared store "
             "before others take its vehicles");
  add.Number("store-wait-seconds", &s.store_wait_seconds, 0, 86400,
             "Seconds that a start, or a task, waits for a shared store that "
             "cannot be reached, starts, recovers or takes no writes; 0 does "
             "not wait");
  add.Number("min-free-bytes", &s.min_free_bytes, 0, std::int64_t{1} << 50,
             "Bytes that the store's file system must have left for writes to "
             "be taken; 0 never refuses them");
  add.Number("max-checked-bytes", &s.max_checked_bytes, 0,
             std::int64_t{1} << 50,
             "Bytes of the largest store whose structure is checked before it "
             "is served");
  add.Choice("damaged-log", DamagedLogs(), &s.damaged_log,
             "What a start does if the write-ahead log is damaged");
  add.Text("admin-listen", &s.admin_listen, "HOST:PORT",
           "Address of /metrics, /livez and /readyz, over plain HTTP and open "
           "to whoever reaches it; port 0 takes a free one; empty: none");
  add.Text("port-file", &s.port_file, "FILE",
           "File to which the address is written once calls are taken");
  add.Choice("end-with-input", Switch(), &s.end_with_input,
             "Whether the end of the standard input ends the server as SIGTERM "
             "does, for a program that starts one for itself");
  add.Number("worker-threads", &s.worker_threads, 0, 1024,
             "Threads for acknowledging poses and other short work; 0 means "
             "one per processor");
  add.Number("search-threads", &s.search_threads, 0, 1024,
             "Threads for searches, which never hold up other work; 0 means "
             "one per processor, but at least 2");
  add.Number("idle-unload-minutes", &s.idle_unload_minutes, 0.01, 1e6,
             "Minutes after which a vehicle that nobody asked for is "
             "unloaded");
  add.Number("memory-budget-mebibytes", &s.memory_budget_mebibytes, 0, 1 << 30,
             "Mebibytes of nodes and edges above which unused vehicles are "
             "unloaded sooner; 0: no limit");
  add.Number("group-memory-mebibytes", &s.group_memory_mebibytes, 0, 1 << 30,
             "Mebibytes of histories that are read from the store for searches "
             "in groups; 0 means a quarter of max-memory-bytes");
  add.Number("snapshot-poses", &s.snapshot_poses, 0, 1 << 30,
             "Poses of a vehicle after which its graph is stored anew as a "
             "snapshot, from which it is loaded faster; 0: no snapshots, nor "
             "what searches have learned");
  add.Number("drain-notice-seconds", &s.drain_notice_seconds, 0, 86400,
             "Seconds that the server still takes calls after SIGTERM while "
             "its health already says NOT_SERVING, so that a balancer turns "
             "to other servers first; a second SIGTERM ends them");
  add.Number("drain-timeout-seconds", &s.drain_timeout_seconds, 0, 86400,
             "Seconds that calls may go on after SIGTERM and the notice");

  add.Number("ack-latency-target-ms", &s.ack_latency_target_ms, 0, 1000,
             "Milliseconds that an acknowledgement may take while poses are "
             "gathered into larger commits because many come; 0 never waits");
}

void AddConnections(Group add, Limits& l) {
  add.Number("max-connections", &l.max_connections, 0, 1000000,
             "Connections at a time; 0 means three quarters of the "
             "descriptors that the process may open, beyond which none are "
             "taken anyway");
  add.Number("max-connections-per-address", &l.max_connections_per_address, 0,
             1000000,
             "Connections at a time from one address; 0 means as many as from "
             "all");
  add.Number("handshake-timeout-seconds", &l.handshake_timeout_seconds, 0.1,
             3600,
             "Seconds after which a connection that has not opened as gRPC "
             "does is closed");
  add.Number("connection-idle-seconds", &l.connection_idle_seconds, 1, 1e6,
             "Seconds without a call after which a connection is closed");
  add.Number("keepalive-seconds", &l.keepalive_seconds, 1, 86400,
             "Seconds of silence after which a connection is pinged");
  add.Number("keepalive-timeout-seconds", &l.keepalive_timeout_seconds, 1, 3600,
             "Seconds after which a connection that does not answer its ping "
             "is closed");
  add.Number("max-concurrent-streams", &l.max_concurrent_streams, 1, 1000000,
             "Calls at a time on one connection; a connection that resets "
             "calls faster than they are cleared away is closed once it holds "
             "1,000 more");
  add.Number("max-metadata-bytes", &l.max_metadata_bytes, 8192, 1 << 24,
             "Bytes of the headers of one call; a call with more ends its "
             "connection, so a proxy in front must allow less");
  add.Number("max-idle-bytes", &l.max_idle_bytes, 0, std::int64_t{1} << 40,
             "Bytes that a connection may bring beyond what its calls and "
             "their messages may; then it is closed; 0: no limit");
  add.Number("max-unadmitted-bytes", &l.max_unadmitted_bytes, 0,
             std::int64_t{1} << 40,
             "max-idle-bytes of a connection that has not had a call let in; "
             "all such connections together may bring four times as much; 0: "
             "no limit");
  add.Number("max-unadmitted-connections", &l.max_unadmitted_connections, 0,
             1000000,
             "Connections that have not had a call let in; if there are more, "
             "the oldest are closed; 0: no limit");
  add.Number("max-transport-bytes", &l.max_transport_bytes, 1 << 24,
             std::int64_t{1} << 40,
             "Bytes that all connections together may buffer");
}

void AddMessages(Group add, Limits& l) {
  add.Number("max-message-bytes", &l.max_message_bytes, 1024, 1 << 30,
             "Bytes of the largest message that is read");
  add.Number("max-batch-poses", &l.max_batch_poses, 1, 1000000,
             "Most poses in a batch");
  add.Number("max-revision-bytes", &l.max_revision_bytes, 1024,
             std::int64_t{1} << 36,
             "Bytes that one RevisePoses call may bring, and all such calls "
             "about one vehicle at a time");
  add.Number("max-draft-bytes", &l.max_draft_bytes, 1024, std::int64_t{1} << 40,
             "Bytes that all RevisePoses calls at a time may bring; one alone "
             "may bring more");
}

void AddWork(Group add, Limits& l) {
  add.Number("max-streams", &l.max_streams, 1, 1000000,
             "Streaming calls at a time");
  add.Number("max-streams-per-vehicle", &l.max_streams_per_vehicle, 1, 1000000,
             "Streaming calls at a time about one vehicle");
  add.Number("max-streams-per-caller", &l.max_streams_per_caller, 0, 1000000,
             "Streaming calls at a time of one caller; 0: no limit");
  add.Number("max-stream-age-seconds", &l.max_stream_age_seconds, 0, 1e6,
             "Seconds after which a StreamPoses call is ended, for its client "
             "to open another, for which a balancer chooses a server again; "
             "each ends up to a tenth sooner, so that not all end together; "
             "0: no limit");
  add.Number("max-batches-in-flight", &l.max_batches_in_flight, 1, 10000,
             "Batches of one stream that may wait for their acknowledgement");
  add.Number("max-bytes-in-flight", &l.max_bytes_in_flight, 1024, 1 << 30,
             "Bytes of memory that the batches of one stream may take which "
             "wait for their acknowledgement; one alone may take more");
  add.Number("max-unread-bytes", &l.max_unread_bytes, 4096,
             std::int64_t{1} << 36,
             "Bytes of one stream's candidates that may wait for the client "
             "to read them; a stream with more is ended");
  add.Number("slow-consumer-seconds", &l.slow_consumer_seconds, 0.1, 3600,
             "Seconds that a client over max-unread-bytes has left to read "
             "its error, and that a client may read nothing of an export");
  add.Number("max-export-bytes", &l.max_export_bytes, 1024,
             std::int64_t{1} << 40,
             "Bytes of memory of all graphs that are being exported; one alone "
             "may take more");
  add.Number("max-pending-appends", &l.max_pending_appends, 1, 1000000,
             "Batches of one vehicle that may wait, over all its streams");
  add.Number("max-queued-bytes-per-vehicle", &l.max_queued_bytes_per_vehicle,
             1024, std::int64_t{1} << 40,
             "Bytes of one vehicle's batches that may wait to be durable");
  add.Number("max-queued-bytes", &l.max_queued_bytes, 1024,
             std::int64_t{1} << 40,
             "Bytes of all batches that may wait to be durable");
  add.Number("max-calls", &l.max_calls, 1, 1000000,
             "Unary calls that may wait or run");
  add.Number("max-calls-per-vehicle", &l.max_calls_per_vehicle, 1, 1000000,
             "Unary calls about one vehicle or group that may wait or run");
  add.Number("max-calls-per-caller", &l.max_calls_per_caller, 0, 1000000,
             "Unary calls of one caller that may wait or run; 0: no limit");
  add.Number("max-rebuilt-poses", &l.max_rebuilt_poses, 1000, 1e12,
             "Poses of the vehicles whose graphs calls make anew at a time, "
             "by revised poses or settings that move nodes; one alone may "
             "have more");
  add.Number("max-rebuilt-poses-per-caller", &l.max_rebuilt_poses_per_caller, 0,
             1e12,
             "max-rebuilt-poses of one caller's calls; one alone may have "
             "more; 0: no limit");
  add.Number("max-searches", &l.max_searches, 1, 1000000,
             "FindCandidates calls that may wait or run; a caller that has "
             "less than an even part of them is let in although others have "
             "taken all");
  add.Number("max-searches-per-vehicle", &l.max_searches_per_vehicle, 1,
             1000000,
             "FindCandidates calls of one vehicle that may wait or run");
  add.Number("max-search-rate-per-caller", &l.max_search_rate_per_caller, 0,
             1e6, "FindCandidates calls per second of one caller; 0: no limit");
  add.Number("max-search-steps", &l.max_search_steps, 1000, 1e12,
             "Nodes of the aligned path times nodes of the history that one "
             "search may compare, counted twice where it looks in both "
             "directions; the marks that a FindCandidates call has to search "
             "first count too, and of a group the histories that may hold the "
             "place");
  add.Choice("default-checks", StoredCheckChoices(), &l.store_checks_by_default,
             "Whether vehicles that are created without a word about it "
             "(settings.checks) have the checks that fall due made and stored");
  add.Number("max-memory-bytes", &l.max_memory_bytes, 0, std::int64_t{1} << 50,
             "Bytes of resident memory from which on new work is refused; 0 "
             "means three quarters of the machine's or the control group's");
}

void AddSecurity(Group add, ServerSettings& s) {
  add.Text("tls-cert", &s.tls_cert, "FILE",
           "Certificate of the server (PEM), followed by those that issued "
           "it; the listener then speaks TLS. Replaced files are taken up");
  add.Text("tls-key", &s.tls_key, "FILE", "Private key of tls-cert (PEM)");
  add.Text("tls-client-ca", &s.tls_client_ca, "FILE",
           "Certificates of the authorities that issue those of clients "
           "(PEM); clients are then asked for theirs");
  add.Choice("tls-client-certs", ClientCertificateChoices(),
             &s.tls_client_certs, "Whether clients need a certificate");
  add.Text("token-keys", &s.token_keys, "FILE",
           "Keys of those who sign bearer tokens (a JSON Web Key Set: RS256, "
           "ES256, EdDSA); such tokens (JWT) are then taken");
  add.Text("token-issuer", &s.token_issuer, "TEXT",
           "Issuer (\"iss\") that tokens must name");
  add.Text("token-audience", &s.token_audience, "TEXT",
           "Audience (\"aud\") that tokens must name, alone or among others");
  add.Number("token-leeway-seconds", &s.token_leeway_seconds, 0, 300,
             "Seconds that the clock of the tokens' issuer may be off");
  add.Text("policy", &s.policy, "FILE",
           "Who may do what with which vehicles (JSON)");
  add.Number("security-check-seconds", &s.security_check_seconds, 0.05, 60,
             "Seconds between two looks at the files of this group, and at "
             "whether the callers of streams may go on");
  add.Choice("serve-health", Switch(), &s.serve_health,
             "The standard health service, open to all");
  add.Choice("serve-reflection", Switch(), &s.serve_reflection,
             "Reflection of the API, open to all");
  add.Choice("insecure-allow-remote", Switch(), &s.insecure_allow_remote,
             "Whether to listen on other than the loopback without TLS or "
             "without asking who calls");
}

void AddLogging(Group add, ServerSettings& s) {
  add.Choice("log-format", LogFormats(), &s.log_format,
             "Form of the log's lines, one per event");
  add.Choice("log-level", LogLevels(), &s.log_level,
             "Level of the least severe events that are logged; SIGUSR2 "
             "changes it while the server runs");
  add.Number("slow-call-seconds", &s.slow_call_seconds, 0, 3600,
             "Seconds from which on a call, or a search of a stream, is logged "
             "as slow, with what the search had to do; 0: none is");
  add.Text("audit-log", &s.audit_log, "FILE",
           "File to which a line is appended for each call that makes, changes "
           "or removes a vehicle, a finding about two poses, or stored poses; "
           "SIGUSR1 opens it again");
}

}  // namespace

std::string Wrapped(const std::string& description) {
  std::string wrapped;
  std::size_t column = 0;
  std::istringstream words(description);
  for (std::string word; words >> word;) {
    if (column > 0) {
      const bool fits = column + 1 + word.size() <= kDescriptionColumns;
      wrapped += fits ? ' ' : '\n';
      column = fits ? column + 1 : 0;
    }
    wrapped += word;
    column += word.size();
  }
  return wrapped;
}

OptionTable::OptionTable(CLI::App* app, ServerSettings* settings) {
  const auto group = [&](const char* name) {
    return Group(name, app, &entries_);
  };
  AddServing(group("Serving"), *settings);
  AddConnections(group("Connections"), settings->limits);
  AddMessages(group("Messages"), settings->limits);
  AddWork(group("Work"), settings->limits);
  AddSecurity(group("Security"), *settings);
  AddLogging(group("Logging"), *settings);
}

absl::Status OptionTable::Set(const std::string& key, const std::string& value,
                              const std::string& where) {
  const auto entry = std::find_if(
      entries_.begin(), entries_.end(),
      [&](const Entry& candidate) { return candidate.key == key; });
  if (entry == entries_.end()) {
    return absl::InvalidArgumentError(
        absl::StrCat(where, ": unknown setting \"", key, "\""));
  }
  try {
    entry->option->clear();
    entry->option->add_result(value);
    entry->option->run_callback();
    // Else the command line's own value would be one too many.
    entry->option->clear();
  } catch (const CLI::Error& error) {
    return absl::InvalidArgumentError(absl::StrCat(where, ": ", error.what()));
  }
  return absl::OkStatus();
}

std::string OptionTable::Print() const {
  std::string text;
  for (const Entry& entry : entries_) {
    absl::StrAppend(&text, entry.key, " = ", entry.value_text(), "\n");
  }
  return text;
}

}  // namespace revisit::server
