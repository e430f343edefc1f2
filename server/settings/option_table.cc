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
  static const auto* const choices =
      new Choices<LogLevel>{{"debug", LogLevel::kDebug},
                            {"info", LogLevel::kInfo},
                            {"warning", LogLevel::kWarning},
                            {"error", LogLevel::kError},
                            {"off", LogLevel::kOff}};
  return *choices;
}

const Choices<ClientCertificates>& ClientCertificateChoices() {
  static const auto* const choices = new Choices<ClientCertificates>{
      {"require", ClientCertificates::kRequire},
      {"optional", ClientCertificates::kVerifyIfGiven}};
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
           "Where to take calls; port 0 takes a free one");
  add.Text(
      "store", &s.store, "PATH",
      "Directory of the store, created if missing; or the store's file, if "
      "that is what the path names");
  add.Number("min-free-bytes", &s.min_free_bytes, 0, std::int64_t{1} << 50,
             "Refuse writes while the store's file system has less left; 0 "
             "never does");
  add.Number("max-checked-bytes", &s.max_checked_bytes, 0,
             std::int64_t{1} << 50,
             "Check the structure of a store up to this size before it is "
             "served");
  add.Choice("damaged-log", DamagedLogs(), &s.damaged_log,
             "At start, if the log is damaged");
  add.Text("port-file", &s.port_file, "FILE",
           "Write the address listened on here once calls are taken");
  add.Number("worker-threads", &s.worker_threads, 0, 1024,
             "Threads for acknowledging poses and other short work; 0 means "
             "one a processor");
  add.Number("search-threads", &s.search_threads, 0, 1024,
             "Threads for searches, loading and reading the store, which "
             "never hold up the others; 0 means one a processor");
  add.Number("idle-unload-minutes", &s.idle_unload_minutes, 0.01, 1e6,
             "Unload a vehicle that nobody has asked for this long");
  add.Number("memory-budget-mebibytes", &s.memory_budget_mebibytes, 0, 1 << 30,
             "Unload unused vehicles sooner above this much memory of nodes "
             "and edges; 0 means as much as it takes");
  add.Number("drain-timeout-seconds", &s.drain_timeout_seconds, 0, 86400,
             "How long calls may go on after SIGTERM");

  add.Number("ack-latency-target-ms", &s.ack_latency_target_ms, 0, 1000,
             "While many poses come, gather them into larger commits as long "
             "as acknowledgements take no longer than this; 0 never waits");
}

void AddConnections(Group add, Limits& l) {
  add.Number("max-connections", &l.max_connections, 0, 1000000,
             "Most at a time; 0 means three quarters of the descriptors that "
             "the process may open, beyond which none are taken anyway");
  add.Number("max-connections-per-address", &l.max_connections_per_address, 0,
             1000000, "Most from one address; 0 means as many as from all");
  add.Number("handshake-timeout-seconds", &l.handshake_timeout_seconds, 0.1,
             3600, "Close one that has not opened as gRPC does by then");
  add.Number("connection-idle-seconds", &l.connection_idle_seconds, 1, 1e6,
             "Close one that had no call for this long");
  add.Number("keepalive-seconds", &l.keepalive_seconds, 1, 86400,
             "Ping one that is silent this long");
  add.Number("keepalive-timeout-seconds", &l.keepalive_timeout_seconds, 1, 3600,
             "Close it if the ping is not answered by then");
  add.Number("max-concurrent-streams", &l.max_concurrent_streams, 1, 1000000,
             "Calls at a time on one connection; one that resets calls faster "
             "than they are cleared away is closed at twice as many");
  add.Number("max-metadata-bytes", &l.max_metadata_bytes, 8192, 1 << 24,
             "Headers of one call; a call with more ends its connection, so a "
             "proxy in front must allow less");
  add.Number("max-idle-bytes", &l.max_idle_bytes, 0, std::int64_t{1} << 40,
             "Close one that has brought so much more than its calls and "
             "messages may; 0: no limit");
  add.Number("max-unadmitted-bytes", &l.max_unadmitted_bytes, 0,
             std::int64_t{1} << 40,
             "The same of one that has not had a call let in; all of them "
             "together may bring four times as much; 0: no limit");
  add.Number("max-unadmitted-connections", &l.max_unadmitted_connections, 0,
             1000000,
             "Connections without a call that was let in; of more, the oldest "
             "are closed; 0: no limit");
  add.Number("max-transport-bytes", &l.max_transport_bytes, 1 << 24,
             std::int64_t{1} << 40, "What all connections together may buffer");
}

void AddMessages(Group add, Limits& l) {
  add.Number("max-message-bytes", &l.max_message_bytes, 1024, 1 << 30,
             "Largest message read");
  add.Number("max-batch-poses", &l.max_batch_poses, 1, 1000000,
             "Most poses in a batch");
  add.Number("max-revision-bytes", &l.max_revision_bytes, 1024,
             std::int64_t{1} << 36,
             "Most bytes one RevisePoses call may bring, and those of one "
             "vehicle at a time");
  add.Number("max-draft-bytes", &l.max_draft_bytes, 1024, std::int64_t{1} << 40,
             "What all of them at a time may bring; one alone may bring more");
}

void AddWork(Group add, Limits& l) {
  add.Number("max-streams", &l.max_streams, 1, 1000000,
             "Streaming calls at a time");
  add.Number("max-streams-per-vehicle", &l.max_streams_per_vehicle, 1, 1000000,
             "Streaming calls at a time about one vehicle");
  add.Number("max-streams-per-caller", &l.max_streams_per_caller, 0, 1000000,
             "Streaming calls at a time of one caller; 0: no limit");
  add.Number("max-batches-in-flight", &l.max_batches_in_flight, 1, 10000,
             "Batches of one stream that may wait for their acknowledgement");
  add.Number("max-bytes-in-flight", &l.max_bytes_in_flight, 1024, 1 << 30,
             "Memory that they may take; one alone may take more");
  add.Number("max-unread-bytes", &l.max_unread_bytes, 4096,
             std::int64_t{1} << 36,
             "Candidates of one stream that may wait for the client to read "
             "them; a stream with more is ended");
  add.Number("slow-consumer-seconds", &l.slow_consumer_seconds, 0.1, 3600,
             "What such a client has left to read why, and how long one may "
             "take nothing of an export");
  add.Number("max-export-bytes", &l.max_export_bytes, 1024,
             std::int64_t{1} << 40,
             "Memory of the graphs that are being exported; one alone may take "
             "more");
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
  add.Number("max-searches", &l.max_searches, 1, 1000000,
             "FindCandidates calls that may wait or run");
  add.Number("max-searches-per-vehicle", &l.max_searches_per_vehicle, 1,
             1000000,
             "FindCandidates calls of one vehicle that may wait or "
             "run");
  add.Number("max-search-rate-per-caller", &l.max_search_rate_per_caller, 0,
             1e6,
             "FindCandidates calls a second of one caller; 0: no "
             "limit");
  add.Number("max-search-steps", &l.max_search_steps, 1000, 1e12,
             "Nodes of the sequence times nodes of the history that one "
             "search may compare");
  add.Number("max-memory-bytes", &l.max_memory_bytes, 0, std::int64_t{1} << 50,
             "Resident memory from which on new work is refused; 0 means "
             "three quarters of what there is");
}

void AddSecurity(Group add, ServerSettings& s) {
  add.Text("tls-cert", &s.tls_cert, "FILE",
           "Serve TLS with this certificate (PEM), followed by those that "
           "issued it; replaced files are taken up");
  add.Text("tls-key", &s.tls_key, "FILE", "Its private key (PEM)");
  add.Text("tls-client-ca", &s.tls_client_ca, "FILE",
           "Ask clients for certificates issued by these (PEM)");
  add.Choice("tls-client-certs", ClientCertificateChoices(),
             &s.tls_client_certs, "Whether clients need one");
  add.Text("token-keys", &s.token_keys, "FILE",
           "Take bearer tokens (JWT) signed by these keys (a JSON Web Key "
           "Set): RS256, ES256, EdDSA");
  add.Text("token-issuer", &s.token_issuer, "TEXT",
           "What their \"iss\" has to be");
  add.Text("token-audience", &s.token_audience, "TEXT",
           "What their \"aud\" has to be or contain");
  add.Number("token-leeway-seconds", &s.token_leeway_seconds, 0, 300,
             "How far the issuer's clock may be off");
  add.Text("policy", &s.policy, "FILE",
           "Who may do what with which vehicles (JSON)");
  add.Number("security-check-seconds", &s.security_check_seconds, 0.05, 60,
             "How often to look at these files, and whether the callers of "
             "streams may go on");
  add.Choice("serve-health", Switch(), &s.serve_health,
             "The standard health service, open to all");
  add.Choice("serve-reflection", Switch(), &s.serve_reflection,
             "Reflection of the API, open to all");
  add.Choice("insecure-allow-remote", Switch(), &s.insecure_allow_remote,
             "Listen on other than the loopback without TLS or without asking "
             "who calls");
}

void AddLogging(Group add, ServerSettings& s) {
  add.Choice("log-format", LogFormats(), &s.log_format,
             "One line an event, as text or as JSON");
  add.Choice("log-level", LogLevels(), &s.log_level,
             "Least severe events that are logged");
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
