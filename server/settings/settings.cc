#include "server/settings/settings.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cctype>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <map>
#include <memory>
#include <set>
#include <sstream>
#include <utility>

#include "absl/status/status.h"

namespace revisit::server {
namespace {

constexpr char kEnvironmentPrefix[] = "REVISIT_";

constexpr char kFooter[] =
    R"(Every setting is also a variable of the environment (--worker-threads is
REVISIT_WORKER_THREADS) and a key of the file that --config or REVISIT_CONFIG
names, with lines such as
  # Comments have lines of their own; strings may stand in double quotes.
  worker-threads = 4
Flags win over the environment, the environment over the file.

Once calls are taken, "listening on ADDRESS" is printed to standard output; logs
go to standard error. SIGTERM or SIGINT drains: new calls are refused, streams
get their last acknowledgements, then the store is closed. SIGHUP has the files
of keys, certificates and policy looked at now.

Exit codes:
  0   stopped as told
  64  wrong usage or settings, or files of keys, certificates or policy that
      are no good
  65  the store is damaged: see "revisitd verify", and restore a backup
  69  cannot listen at the address, or write the port file
  73  the store is in use by another server, or is no store of this version
  74  the store cannot be read or written, or a flush failed

Examples:
  revisitd
  revisitd --listen 0.0.0.0:50051 --store /var/lib/revisit \
    --tls-cert server.crt --tls-key server.key --policy policy.json \
    --token-keys keys.json --token-issuer https://login.example \
    --token-audience revisit
  revisitd --worker-threads 2 --print-config > revisitd.conf
  revisitd backup --store /var/lib/revisit --to /backup/monday.sqlite
  revisitd verify --store /backup/monday.sqlite
  revisitd compact --store /var/lib/revisit
)";

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
std::string NumberText(double value) {
  char text[32];
  for (int digits = 6; digits <= 17; ++digits) {
    std::snprintf(text, sizeof(text), "%.*g", digits, value);
    if (std::strtod(text, nullptr) == value) break;
  }
  return text;
}
std::string NumberText(std::int64_t value) { return std::to_string(value); }
std::string NumberText(int value) { return std::to_string(value); }

std::string QuotedText(const std::string& text) {
  std::string quoted = "\"";
  for (const char c : text) {
    if (c == '\n') {
      quoted += "\\n";
      continue;
    }
    if (c == '"' || c == '\\') quoted += '\\';
    quoted += c;
  }
  return quoted + "\"";
}

// One setting: its option, and how it is printed.
struct Option {
  CLI::Option* option;
  std::function<std::string()> value_text;
};
using Options = std::map<std::string, Option>;

// Columns of the help before the descriptions, and of these.
constexpr std::size_t kNameColumns = 34;
constexpr std::size_t kDescriptionColumns = 46;

// With line breaks, so that the help fits 80 columns.
std::string Wrapped(const std::string& text) {
  std::string wrapped;
  std::size_t column = 0;
  std::istringstream words(text);
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

// The settings as options of a command line. The app and the settings must
// outlive this.
class OptionTable {
 public:
  OptionTable(CLI::App* app, ServerSettings* settings)
      : app_(app), settings_(settings) {
    AddOptions();
  }

  const std::vector<std::string>& keys() const { return keys_; }
  const Options& options() const { return options_; }

  // Takes a value from the environment or the file.
  absl::Status Set(const std::string& key, const std::string& value,
                   const std::string& where) {
    const auto entry = options_.find(key);
    if (entry == options_.end()) {
      return absl::InvalidArgumentError(
          (where + ": unknown setting \"" + key + "\"").c_str());
    }
    try {
      entry->second.option->clear();
      entry->second.option->add_result(value);
      entry->second.option->run_callback();
      // Else the command line's own value would be one too many.
      entry->second.option->clear();
    } catch (const CLI::Error& error) {
      return absl::InvalidArgumentError((where + ": " + error.what()).c_str());
    }
    return absl::OkStatus();
  }

 private:
  void AddOptions() {
    ServerSettings& s = *settings_;
    const char* serving = "Serving";
    AddText(serving, "listen", &s.listen, "HOST:PORT",
            "Where to take calls; port 0 takes a free one");
    AddText(
        serving, "store", &s.store, "PATH",
        "Directory of the store, created if missing; or the store's file, if "
        "that is what the path names");
    AddNumber(serving, "min-free-bytes", &s.min_free_bytes, 0,
              std::int64_t{1} << 50,
              "Refuse writes while the store's file system has less left; 0 "
              "never does");
    AddNumber(serving, "max-checked-bytes", &s.max_checked_bytes, 0,
              std::int64_t{1} << 50,
              "Check the structure of a store up to this size before it is "
              "served");
    AddChoice(serving, "damaged-log", DamagedLogs(), &s.damaged_log,
              "At start, if the log is damaged");
    AddText(serving, "port-file", &s.port_file, "FILE",
            "Write the address listened on here once calls are taken");
    AddNumber(serving, "worker-threads", &s.worker_threads, 0, 1024,
              "Threads for acknowledging poses and other short work; 0 means "
              "one a processor");
    AddNumber(serving, "search-threads", &s.search_threads, 0, 1024,
              "Threads for searches, loading and reading the store, which "
              "never hold up the others; 0 means one a processor");
    AddNumber(serving, "idle-unload-minutes", &s.idle_unload_minutes, 0.01, 1e6,
              "Unload a vehicle that nobody has asked for this long");
    AddNumber(serving, "memory-budget-mebibytes", &s.memory_budget_mebibytes, 0,
              1 << 30,
              "Unload unused vehicles sooner above this much memory of nodes "
              "and edges; 0 means as much as it takes");
    AddNumber(serving, "drain-timeout-seconds", &s.drain_timeout_seconds, 0,
              86400, "How long calls may go on after SIGTERM");

    AddNumber(serving, "ack-latency-target-ms", &s.ack_latency_target_ms, 0,
              1000,
              "While many poses come, gather them into larger commits as long "
              "as acknowledgements take no longer than this; 0 never waits");

    AddLimits();

    const char* security = "Security";
    AddText(security, "tls-cert", &s.tls_cert, "FILE",
            "Serve TLS with this certificate (PEM), followed by those that "
            "issued it; replaced files are taken up");
    AddText(security, "tls-key", &s.tls_key, "FILE", "Its private key (PEM)");
    AddText(security, "tls-client-ca", &s.tls_client_ca, "FILE",
            "Ask clients for certificates issued by these (PEM)");
    AddChoice(security, "tls-client-certs", ClientCertificateChoices(),
              &s.tls_client_certs, "Whether clients need one");
    AddText(security, "token-keys", &s.token_keys, "FILE",
            "Take bearer tokens (JWT) signed by these keys (a JSON Web Key "
            "Set): RS256, ES256, EdDSA");
    AddText(security, "token-issuer", &s.token_issuer, "TEXT",
            "What their \"iss\" has to be");
    AddText(security, "token-audience", &s.token_audience, "TEXT",
            "What their \"aud\" has to be or contain");
    AddNumber(security, "token-leeway-seconds", &s.token_leeway_seconds, 0, 300,
              "How far the issuer's clock may be off");
    AddText(security, "policy", &s.policy, "FILE",
            "Who may do what with which vehicles (JSON)");
    AddNumber(security, "security-check-seconds", &s.security_check_seconds,
              0.05, 60,
              "How often to look at these files, and whether the callers of "
              "streams may go on");
    AddChoice(security, "serve-health", Switch(), &s.serve_health,
              "The standard health service, open to all");
    AddChoice(security, "serve-reflection", Switch(), &s.serve_reflection,
              "Reflection of the API, open to all");
    AddChoice(security, "insecure-allow-remote", Switch(),
              &s.insecure_allow_remote,
              "Listen on other than the loopback without TLS or without asking "
              "who calls");

    const char* logging = "Logging";
    AddChoice(logging, "log-format", LogFormats(), &s.log_format,
              "One line an event, as text or as JSON");
    AddChoice(logging, "log-level", LogLevels(), &s.log_level,
              "Least severe events that are logged");
  }

  void AddLimits() {
    Limits& l = settings_->limits;
    const char* connections = "Connections";
    AddNumber(connections, "max-connections", &l.max_connections, 0, 1000000,
              "Most at a time; 0 means three quarters of the descriptors that "
              "the process may open, beyond which none are taken anyway");
    AddNumber(connections, "max-connections-per-address",
              &l.max_connections_per_address, 0, 1000000,
              "Most from one address; 0 means as many as from all");
    AddNumber(connections, "handshake-timeout-seconds",
              &l.handshake_timeout_seconds, 0.1, 3600,
              "Close one that has not opened as gRPC does by then");
    AddNumber(connections, "connection-idle-seconds",
              &l.connection_idle_seconds, 1, 1e6,
              "Close one that had no call for this long");
    AddNumber(connections, "keepalive-seconds", &l.keepalive_seconds, 1, 86400,
              "Ping one that is silent this long");
    AddNumber(connections, "keepalive-timeout-seconds",
              &l.keepalive_timeout_seconds, 1, 3600,
              "Close it if the ping is not answered by then");
    AddNumber(connections, "max-concurrent-streams", &l.max_concurrent_streams,
              1, 1000000,
              "Calls at a time on one connection; one that resets calls faster "
              "than they are cleared away is closed at twice as many");
    AddNumber(connections, "max-metadata-bytes", &l.max_metadata_bytes, 8192,
              1 << 24,
              "Headers of one call; a call with more ends its connection, so a "
              "proxy in front must allow less");
    AddNumber(connections, "max-idle-bytes", &l.max_idle_bytes, 0,
              std::int64_t{1} << 40,
              "Close one that has brought so much more than its calls and "
              "messages may; 0: no limit");
    AddNumber(connections, "max-unadmitted-bytes", &l.max_unadmitted_bytes, 0,
              std::int64_t{1} << 40,
              "The same of one that has not had a call let in; all of them "
              "together may bring four times as much; 0: no limit");
    AddNumber(connections, "max-unadmitted-connections",
              &l.max_unadmitted_connections, 0, 1000000,
              "Connections without a call that was let in; of more, the oldest "
              "are closed; 0: no limit");
    AddNumber(connections, "max-transport-bytes", &l.max_transport_bytes,
              1 << 24, std::int64_t{1} << 40,
              "What all connections together may buffer");

    const char* messages = "Messages";
    AddNumber(messages, "max-message-bytes", &l.max_message_bytes, 1024,
              1 << 30, "Largest message read");
    AddNumber(messages, "max-batch-poses", &l.max_batch_poses, 1, 1000000,
              "Most poses in a batch");
    AddNumber(messages, "max-revision-bytes", &l.max_revision_bytes, 1024,
              std::int64_t{1} << 36,
              "Most bytes one RevisePoses call may bring, and those of one "
              "vehicle at a time");
    AddNumber(messages, "max-draft-bytes", &l.max_draft_bytes, 1024,
              std::int64_t{1} << 40,
              "What all of them at a time may bring; one alone may bring more");

    const char* work = "Work";
    AddNumber(work, "max-streams", &l.max_streams, 1, 1000000,
              "Streaming calls at a time");
    AddNumber(work, "max-streams-per-vehicle", &l.max_streams_per_vehicle, 1,
              1000000, "Streaming calls at a time about one vehicle");
    AddNumber(work, "max-streams-per-caller", &l.max_streams_per_caller, 0,
              1000000, "Streaming calls at a time of one caller; 0: no limit");
    AddNumber(work, "max-batches-in-flight", &l.max_batches_in_flight, 1, 10000,
              "Batches of one stream that may wait for their acknowledgement");
    AddNumber(work, "max-bytes-in-flight", &l.max_bytes_in_flight, 1024,
              1 << 30, "Memory that they may take; one alone may take more");
    AddNumber(work, "max-unread-bytes", &l.max_unread_bytes, 4096,
              std::int64_t{1} << 36,
              "Candidates of one stream that may wait for the client to read "
              "them; a stream with more is ended");
    AddNumber(work, "slow-consumer-seconds", &l.slow_consumer_seconds, 0.1,
              3600,
              "What such a client has left to read why, and how long one may "
              "take nothing of an export");
    AddNumber(
        work, "max-export-bytes", &l.max_export_bytes, 1024,
        std::int64_t{1} << 40,
        "Memory of the graphs that are being exported; one alone may take "
        "more");
    AddNumber(work, "max-pending-appends", &l.max_pending_appends, 1, 1000000,
              "Batches of one vehicle that may wait, over all its streams");
    AddNumber(work, "max-queued-bytes-per-vehicle",
              &l.max_queued_bytes_per_vehicle, 1024, std::int64_t{1} << 40,
              "Bytes of one vehicle's batches that may wait to be durable");
    AddNumber(work, "max-queued-bytes", &l.max_queued_bytes, 1024,
              std::int64_t{1} << 40,
              "Bytes of all batches that may wait to be durable");
    AddNumber(work, "max-calls", &l.max_calls, 1, 1000000,
              "Unary calls that may wait or run");
    AddNumber(work, "max-searches", &l.max_searches, 1, 1000000,
              "FindCandidates calls that may wait or run");
    AddNumber(work, "max-searches-per-vehicle", &l.max_searches_per_vehicle, 1,
              1000000,
              "FindCandidates calls of one vehicle that may wait or "
              "run");
    AddNumber(work, "max-search-rate-per-caller", &l.max_search_rate_per_caller,
              0, 1e6,
              "FindCandidates calls a second of one caller; 0: no "
              "limit");
    AddNumber(work, "max-search-steps", &l.max_search_steps, 1000, 1e12,
              "Nodes of the sequence times nodes of the history that one "
              "search may compare");
    AddNumber(work, "max-memory-bytes", &l.max_memory_bytes, 0,
              std::int64_t{1} << 50,
              "Resident memory from which on new work is refused; 0 means "
              "three quarters of what there is");
  }

  void Register(const char* group, const std::string& key, CLI::Option* option,
                std::function<std::string()> value_text) {
    option->group(group);
    keys_.push_back(key);
    options_[key] = {option, std::move(value_text)};
  }

  void AddText(const char* group, const std::string& key, std::string* value,
               const char* type, const char* description) {
    Register(group, key,
             app_->add_option("--" + key, *value, Wrapped(description))
                 ->type_name(type)
                 ->capture_default_str(),
             [value] { return QuotedText(*value); });
  }

  // The bounds may be literals of another type than the value.
  template <typename T, typename Lowest, typename Highest>
  void AddNumber(const char* group, const std::string& key, T* value,
                 Lowest lowest, Highest highest, const char* description) {
    AddNumberInRange<T>(group, key, value, static_cast<T>(lowest),
                        static_cast<T>(highest), description);
  }

  template <typename T>
  void AddNumberInRange(const char* group, const std::string& key, T* value,
                        T lowest, T highest, const char* description) {
    const auto check = [lowest, highest](const std::string& text) {
      T number{};
      // Written so that not-a-number fails.
      if (CLI::detail::lexical_cast(text, number) && number >= lowest &&
          number <= highest) {
        return std::string();
      }
      return "got \"" + text + "\"; allowed is a number in [" +
             NumberText(lowest) + ", " + NumberText(highest) + "]";
    };
    Register(group, key,
             app_->add_option("--" + key, *value, Wrapped(description))
                 ->type_name("N")
                 ->check(CLI::Validator(check, ""))
                 ->default_str(NumberText(*value)),
             [value] { return NumberText(*value); });
  }

  template <typename T>
  void AddChoice(const char* group, const std::string& key,
                 const Choices<T>& choices, T* value, const char* description) {
    std::string names;
    for (const auto& choice : choices) {
      names += (names.empty() ? "" : "|") + choice.first;
    }
    const auto check = [&choices, names](const std::string& text) {
      for (const auto& choice : choices) {
        if (choice.first == text) return std::string();
      }
      return "got \"" + text + "\"; allowed is " + names;
    };
    const auto assign = [&choices, value](const std::string& text) {
      for (const auto& [name, choice] : choices) {
        if (name == text) *value = choice;
      }
    };
    Register(
        group, key,
        app_->add_option_function<std::string>("--" + key, assign,
                                               Wrapped(description))
            ->type_name(names)
            ->check(CLI::Validator(check, ""))
            ->default_str(ChoiceName(choices, *value)),
        [&choices, value] { return QuotedText(ChoiceName(choices, *value)); });
  }

  CLI::App* const app_;
  ServerSettings* const settings_;
  std::vector<std::string> keys_;
  Options options_;
};

// One parser with all options, and what it fills.
struct Parser {
  Parser() {
    app.name("revisitd");
    app.get_formatter()->column_width(kNameColumns);
    app.footer(kFooter);
    app.set_version_flag("--version", "revisitd " REVISIT_VERSION);
    app.add_option("--config", config, "File of settings")->type_name("FILE");
    app.add_flag("--print-config", print_config,
                 Wrapped("Print all settings in the form of the file, and "
                         "stop"));
    backup = app.add_subcommand("backup", "Copy the store and check the copy");
    backup->add_option("--to", task.destination, "File to make")
        ->type_name("FILE")
        ->required();
    verify = app.add_subcommand("verify",
                                "Read the whole store and say what is wrong");
    compact =
        app.add_subcommand("compact", "Make the file of a stopped store small");
    for (CLI::App* subcommand : {backup, verify, compact}) {
      subcommand->fallthrough();
      subcommand->footer("--store and --config are those of revisitd itself.");
    }
    table = std::make_unique<OptionTable>(&app, &settings);
  }

  // Sets `print` for help and version.
  absl::Status ParseArguments(const std::vector<std::string>& arguments) {
    // CLI11 takes them from the back.
    std::vector<std::string> reversed(arguments.rbegin(), arguments.rend());
    try {
      app.parse(std::move(reversed));
    } catch (const CLI::CallForHelp&) {
      print = app.help();
    } catch (const CLI::CallForVersion& version) {
      print = std::string(version.what()) + "\n";
    } catch (const CLI::Error& error) {
      return absl::InvalidArgumentError(error.what());
    }
    return absl::OkStatus();
  }

  std::optional<StoreTask> Task() const {
    for (const auto& [subcommand, kind] :
         {std::pair(backup, StoreTask::Kind::kBackup),
          std::pair(verify, StoreTask::Kind::kVerify),
          std::pair(compact, StoreTask::Kind::kCompact)}) {
      if (!subcommand->parsed()) continue;
      StoreTask asked = task;
      asked.kind = kind;
      return asked;
    }
    return std::nullopt;
  }

  ServerSettings settings;
  StoreTask task{};
  CLI::App* backup = nullptr;
  CLI::App* verify = nullptr;
  CLI::App* compact = nullptr;
  std::string config;
  bool print_config = false;
  std::optional<std::string> print;
  CLI::App app{
      "Keeps one pose graph a vehicle and answers where the vehicle has\n"
      "probably been before."};
  std::unique_ptr<OptionTable> table;
};

std::string Trimmed(const std::string& text) {
  const char* space = " \t\r";
  const std::size_t first = text.find_first_not_of(space);
  if (first == std::string::npos) return "";
  return text.substr(first, text.find_last_not_of(space) - first + 1);
}

// The text between quotes; nothing if it is not a well-formed string.
std::optional<std::string> Unquoted(const std::string& text) {
  if (text.size() < 2 || text.back() != '"') return std::nullopt;
  std::string plain;
  for (std::size_t i = 1; i + 1 < text.size(); ++i) {
    char c = text[i];
    if (c == '"') return std::nullopt;
    if (c == '\\') {
      if (++i + 1 >= text.size()) return std::nullopt;
      c = text[i];
      if (c == 'n') {
        c = '\n';
      } else if (c != '"' && c != '\\') {
        return std::nullopt;
      }
    }
    plain += c;
  }
  return plain;
}

absl::Status ApplyFile(const std::string& path, OptionTable* table) {
  std::ifstream file(path);
  if (!file) {
    return absl::InvalidArgumentError(
        ("cannot read the file of settings " + path).c_str());
  }
  std::set<std::string> seen;
  std::string line;
  for (int number = 1; std::getline(file, line); ++number) {
    const std::string where = path + ":" + std::to_string(number);
    line = Trimmed(line);
    if (line.empty() || line[0] == '#') continue;
    const std::size_t equals = line.find('=');
    if (equals == std::string::npos) {
      return absl::InvalidArgumentError(
          (where + ": expected KEY = VALUE").c_str());
    }
    const std::string key = Trimmed(line.substr(0, equals));
    std::string value = Trimmed(line.substr(equals + 1));
    if (!value.empty() && value[0] != '"' &&
        value.find('#') != std::string::npos) {
      return absl::InvalidArgumentError(
          (where + ": " + key + ": got " + value +
           "; a comment has a line of its own, and a value with # stands in "
           "double quotes")
              .c_str());
    }
    if (!value.empty() && value[0] == '"') {
      const std::optional<std::string> plain = Unquoted(value);
      if (!plain) {
        return absl::InvalidArgumentError(
            (where + ": " + key + ": malformed string").c_str());
      }
      value = *plain;
    }
    if (!seen.insert(key).second) {
      return absl::InvalidArgumentError(
          (where + ": " + key + " stands twice").c_str());
    }
    if (absl::Status status = table->Set(key, value, where); !status.ok()) {
      return status;
    }
  }
  if (file.bad()) {
    return absl::InvalidArgumentError(
        ("cannot read the file of settings " + path).c_str());
  }
  return absl::OkStatus();
}

// Variables with our prefix that are no settings of the server: the command
// line's and the tests'.
bool BelongsToOthers(const std::string& name) {
  return name == "REVISIT_SERVER" || name == "REVISIT_BIN" ||
         name.rfind("REVISIT_TEST_", 0) == 0;
}

absl::Status ApplyEnvironment(const std::vector<std::string>& environment,
                              std::string* config, OptionTable* table) {
  const std::string prefix = kEnvironmentPrefix;
  for (const std::string& variable : environment) {
    const std::size_t equals = variable.find('=');
    if (equals == std::string::npos || variable.rfind(prefix, 0) != 0) continue;
    const std::string name = variable.substr(0, equals);
    const std::string value = variable.substr(equals + 1);
    if (BelongsToOthers(name)) continue;
    std::string key = name.substr(prefix.size());
    for (char& c : key) {
      c = c == '_'
              ? '-'
              : static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    }
    if (key == "config") {
      if (config != nullptr) *config = value;
      continue;
    }
    if (table == nullptr) continue;
    if (absl::Status status = table->Set(key, value, "environment, " + name);
        !status.ok()) {
      return status;
    }
  }
  return absl::OkStatus();
}

// Host and port of an address that is no socket of the file system. The host
// without the brackets of IPv6.
std::string HostOf(const std::string& address) {
  const std::string host = address.substr(0, address.rfind(':'));
  if (host.size() > 2 && host.front() == '[' && host.back() == ']') {
    return host.substr(1, host.size() - 2);
  }
  return host;
}

bool IsLoopback(const std::string& address) {
  if (address.rfind("unix:", 0) == 0 ||
      address.rfind("unix-abstract:", 0) == 0) {
    return true;
  }
  const std::string host = HostOf(address);
  if (host == "localhost") return true;
  in_addr four{};
  if (inet_pton(AF_INET, host.c_str(), &four) == 1) {
    return ntohl(four.s_addr) >> 24 == 127;
  }
  in6_addr six{};
  return inet_pton(AF_INET6, host.c_str(), &six) == 1 &&
         IN6_IS_ADDR_LOOPBACK(&six);
}

absl::Status CheckSecurity(const ServerSettings& s) {
  const auto problem = [](const char* what) {
    return absl::InvalidArgumentError(what);
  };
  if (s.tls_cert.empty() != s.tls_key.empty()) {
    return problem("tls-cert and tls-key are needed together");
  }
  if (!s.tls_client_ca.empty() && s.tls_cert.empty()) {
    return problem("tls-client-ca needs tls-cert and tls-key");
  }
  if (s.token_keys.empty() != s.token_issuer.empty() ||
      s.token_keys.empty() != s.token_audience.empty()) {
    return problem(
        "token-keys, token-issuer and token-audience are needed together");
  }
  const bool asks = !s.token_keys.empty() || !s.tls_client_ca.empty();
  if (asks && s.policy.empty()) {
    return problem(
        "token-keys and tls-client-ca need policy: without it nobody may do "
        "anything");
  }
  if (!asks && !s.policy.empty()) {
    return problem(
        "policy needs token-keys or tls-client-ca: without them nobody can "
        "show who calls");
  }
  const std::string risk = RiskOfListening(s);
  if (!risk.empty() && !s.insecure_allow_remote) {
    return absl::InvalidArgumentError(
        ("listen is " + s.listen + ": " + risk +
         ". Give tls-cert, tls-key, policy and token-keys or tls-client-ca; "
         "or listen on 127.0.0.1; or, if nobody else can reach the address, "
         "say insecure-allow-remote on")
            .c_str());
  }
  return absl::OkStatus();
}

std::string PrintTable(const OptionTable& table) {
  std::string text;
  for (const std::string& key : table.keys()) {
    text += key + " = " + table.options().at(key).value_text() + "\n";
  }
  return text;
}

}  // namespace

absl::StatusOr<ParsedSettings> ParseSettings(
    const std::vector<std::string>& arguments,
    const std::vector<std::string>& environment) {
  // The flags are read twice: first to learn which file comes before them.
  Parser first;
  if (absl::Status status = first.ParseArguments(arguments); !status.ok()) {
    return status;
  }
  if (first.print) {
    return ParsedSettings{first.settings, std::nullopt, first.print};
  }
  std::string config;
  if (absl::Status status = ApplyEnvironment(environment, &config, nullptr);
      !status.ok()) {
    return status;
  }
  if (!first.config.empty()) config = first.config;

  Parser parser;
  if (!config.empty()) {
    if (absl::Status status = ApplyFile(config, parser.table.get());
        !status.ok()) {
      return status;
    }
  }
  if (absl::Status status =
          ApplyEnvironment(environment, nullptr, parser.table.get());
      !status.ok()) {
    return status;
  }
  if (absl::Status status = parser.ParseArguments(arguments); !status.ok()) {
    return status;
  }
  if (!parser.print && !parser.print_config && !parser.Task()) {
    if (absl::Status status = CheckSecurity(parser.settings); !status.ok()) {
      return status;
    }
  }
  ParsedSettings parsed{parser.settings, parser.Task(), std::nullopt};
  if (parser.print_config) parsed.print = PrintSettings(parser.settings);
  return parsed;
}

std::string RiskOfListening(const ServerSettings& settings) {
  if (IsLoopback(settings.listen)) return "";
  if (settings.policy.empty()) {
    return "whoever reaches this address could read and change all vehicles";
  }
  if (settings.tls_cert.empty()) {
    return "whoever is on the way to this address could read and take tokens";
  }
  return "";
}

std::vector<std::string> ProcessEnvironment() {
  std::vector<std::string> environment;
  for (char** variable = environ; *variable != nullptr; ++variable) {
    environment.emplace_back(*variable);
  }
  return environment;
}

std::string PrintSettings(const ServerSettings& settings) {
  Parser parser;
  parser.settings = settings;
  return PrintTable(*parser.table);
}

}  // namespace revisit::server
