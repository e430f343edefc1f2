#include "server/settings/settings.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <unistd.h>

#include <cctype>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "server/base/listen_address.h"
#include "server/settings/command_line.h"
#include "server/settings/settings_file.h"

namespace revisit::server {
namespace {

constexpr char kEnvironmentPrefix[] = "REVISIT_";

// ---- Environment

// Variables with our prefix that are no settings of the server: programs beside
// it read them, often from the same environment. REVISIT_TLS_CERT and
// REVISIT_TLS_KEY are not among them, since they mean the same to the command
// line and to the server: what each shows of itself.
constexpr absl::string_view kVariablesOfOthers[] = {
    // The command line and the clients.
    "REVISIT_CONTEXT", "REVISIT_CONTEXTS_FILE", "REVISIT_PROGRAM",
    "REVISIT_SERVER", "REVISIT_SERVER_PROGRAM", "REVISIT_TLS_CA",
    "REVISIT_TOKEN_FILE",
    // The console, which has more that begin with REVISIT_CONSOLE_.
    "REVISIT_BASE_MAP", "REVISIT_METRICS",
    // The tests, which have more that begin with REVISIT_TEST_.
    "REVISIT_BIN"};

bool BelongsToOthers(absl::string_view name) {
  return absl::c_linear_search(kVariablesOfOthers, name) ||
         absl::StartsWith(name, "REVISIT_CONSOLE_") ||
         absl::StartsWith(name, "REVISIT_TEST_");
}

// The key that a variable stands for: `node-budget` for REVISIT_NODE_BUDGET.
std::string KeyOf(const std::string& name) {
  std::string key = name.substr(sizeof(kEnvironmentPrefix) - 1);
  for (char& c : key) {
    c = c == '_'
            ? '-'
            : static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  }
  return key;
}

// Calls `take` for each variable that is a setting, or names the file of them.
absl::Status ReadEnvironment(const std::vector<std::string>& environment,
                             const TakeSetting& take) {
  for (const std::string& variable : environment) {
    const std::size_t equals = variable.find('=');
    if (equals == std::string::npos ||
        variable.rfind(kEnvironmentPrefix, 0) != 0) {
      continue;
    }
    const std::string name = variable.substr(0, equals);
    if (BelongsToOthers(name)) continue;
    if (absl::Status status = take(KeyOf(name), variable.substr(equals + 1),
                                   absl::StrCat("environment, ", name));
        !status.ok()) {
      return status;
    }
  }
  return absl::OkStatus();
}

// The file that the environment names; empty if none.
std::string ConfigOf(const std::vector<std::string>& environment) {
  std::string config;
  (void)ReadEnvironment(environment,
                        [&](const std::string& key, const std::string& value,
                            const std::string&) {
                          if (key == "config") config = value;
                          return absl::OkStatus();
                        });
  return config;
}

// ---- Settings that go together

bool IsSocketOfUnix(const std::string& address) {
  return absl::StartsWith(address, "unix:") ||
         absl::StartsWith(address, "unix-abstract:");
}

bool IsLoopback(const std::string& address) {
  if (IsSocketOfUnix(address)) return true;
  const absl::StatusOr<ListenAddress> parsed = ParseListenAddress(address);
  if (!parsed.ok()) return false;
  const std::string& host = parsed->host;
  if (host == "localhost") return true;
  in_addr four{};
  if (inet_pton(AF_INET, host.c_str(), &four) == 1) {
    return ntohl(four.s_addr) >> 24 == 127;
  }
  in6_addr six{};
  return inet_pton(AF_INET6, host.c_str(), &six) == 1 &&
         IN6_IS_ADDR_LOOPBACK(&six);
}

// The form of the addresses, before it is asked who may reach them.
absl::Status CheckAddresses(const ServerSettings& s) {
  const auto check = [](const char* key, const std::string& address) {
    const absl::Status status = ParseListenAddress(address).status();
    return status.ok() ? status
                       : absl::InvalidArgumentError(
                             absl::StrCat(key, ": ", status.message()));
  };
  if (!IsSocketOfUnix(s.listen)) {
    if (absl::Status status = check("listen", s.listen); !status.ok()) {
      return status;
    }
  }
  return s.admin_listen.empty() ? absl::OkStatus()
                                : check("admin-listen", s.admin_listen);
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
    return absl::InvalidArgumentError(absl::StrCat(
        "listen is ", s.listen, ": ", risk,
        ". Give tls-cert, tls-key, policy and token-keys or tls-client-ca; or "
        "listen on 127.0.0.1; or, if nobody else can reach the address, say "
        "insecure-allow-remote on"));
  }
  return absl::OkStatus();
}

// The settings that a server or a task is to begin with.
absl::Status Check(const CommandLine& line) {
  const ServerSettings& settings = line.settings();
  if (line.print_config()) return absl::OkStatus();
  if (settings.store.empty()) {
    return absl::InvalidArgumentError(
        "store: got \"\"; allowed is a path, or postgresql://...");
  }
  if (line.Task()) return absl::OkStatus();
  if (absl::Status status = CheckAddresses(settings); !status.ok()) {
    return status;
  }
  return CheckSecurity(settings);
}

}  // namespace

std::chrono::milliseconds StoreWaitTime(const ServerSettings& settings) {
  return Milliseconds(settings.store_wait_seconds);
}

absl::StatusOr<ParsedSettings> ParseSettings(
    const std::vector<std::string>& arguments,
    const std::vector<std::string>& environment) {
  // The flags are read twice: first to learn which file comes before them.
  CommandLine first;
  if (absl::Status status = first.Parse(arguments); !status.ok()) {
    return status;
  }
  if (first.print()) {
    return ParsedSettings{first.settings(), std::nullopt, first.print()};
  }
  const std::string config =
      first.config().empty() ? ConfigOf(environment) : first.config();

  CommandLine line;
  const TakeSetting set = [&](const std::string& key, const std::string& value,
                              const std::string& where) {
    return line.table().Set(key, value, where);
  };
  if (!config.empty()) {
    if (absl::Status status = ReadSettingsFile(config, set); !status.ok()) {
      return status;
    }
  }
  absl::Status status = ReadEnvironment(
      environment, [&](const std::string& key, const std::string& value,
                       const std::string& where) {
        return key == "config" ? absl::OkStatus() : set(key, value, where);
      });
  if (!status.ok()) return status;
  status = line.Parse(arguments);
  if (!status.ok()) return status;
  status = Check(line);
  if (!status.ok()) return status;
  ParsedSettings parsed{line.settings(), line.Task(), std::nullopt};
  if (line.print_config()) parsed.print = PrintSettings(line.settings());
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
  return CommandLine(settings).table().Print();
}

}  // namespace revisit::server
