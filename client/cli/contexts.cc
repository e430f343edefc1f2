#include "client/cli/contexts.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/terminal/file_error.h"
#include "client/terminal/replaced_file.h"
#include "client/terminal/terminal.h"
#include "core/base/suggestion.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

// A descriptor that is closed, and with it the lock that it has.
class Descriptor {
 public:
  explicit Descriptor(int number) : number_(number) {}
  ~Descriptor() {
    if (number_ >= 0) close(number_);
  }

  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;

  int number() const { return number_; }

 private:
  const int number_;
};

absl::Status Wrong(const std::string& path, const std::string& problem) {
  return LocalError(
      absl::InvalidArgumentError(absl::StrCat(path, ": ", problem)));
}

// "no such key; did you mean tls-ca? allowed is ..."
absl::Status UnknownKey(const std::string& path, const std::string& place,
                        const std::string& key,
                        const std::vector<std::string>& known) {
  return Wrong(path, absl::StrCat(place, ": ", MistypedWord(key, known)));
}

// Sets `text` to the text that a key has.
absl::Status TakeText(const std::string& path, const std::string& key,
                      const Json& value, std::string* text) {
  if (!value.is_string()) {
    return Wrong(path, absl::StrCat(key, ": allowed is a text, got ",
                                    JsonText(value, false)));
  }
  *text = value.get<std::string>();
  return absl::OkStatus();
}

absl::StatusOr<ChannelOptions> ParseServer(const std::string& path,
                                           const std::string& place,
                                           const Json& json) {
  if (!json.is_object()) {
    return Wrong(path, absl::StrCat(place, ": allowed is an object"));
  }
  std::vector<std::string> known;
  for (const ContextKey& key : kContextKeys) known.push_back(key.name);
  ChannelOptions server;
  for (const auto& [name, value] : json.items()) {
    const auto* const key = std::find_if(
        std::begin(kContextKeys), std::end(kContextKeys),
        [&name = name](const ContextKey& row) { return name == row.name; });
    if (key == std::end(kContextKeys)) {
      return UnknownKey(path, place, name, known);
    }
    const absl::Status taken = TakeText(path, absl::StrCat(place, ".", name),
                                        value, &(server.*key->option));
    if (!taken.ok()) return taken;
  }
  if (std::string problem = CheckServer(server); !problem.empty()) {
    return Wrong(path, absl::StrCat(place, ": ", problem));
  }
  return server;
}

absl::Status ParseServers(const std::string& path, const Json& json,
                          Contexts* contexts) {
  if (!json.is_object()) return Wrong(path, "contexts: allowed is an object");
  for (const auto& [name, value] : json.items()) {
    if (std::string problem = CheckContextName(name); !problem.empty()) {
      return Wrong(path, absl::StrCat("contexts: ", problem));
    }
    auto server = ParseServer(path, absl::StrCat("contexts.", name), value);
    if (!server.ok()) return server.status();
    contexts->servers[name] = *std::move(server);
  }
  return absl::OkStatus();
}

absl::StatusOr<Contexts> Parse(const std::string& path, const Json& json) {
  if (!json.is_object()) return Wrong(path, "allowed is an object");
  Contexts contexts;
  for (const auto& [key, value] : json.items()) {
    const absl::Status taken =
        key == "current" ? TakeText(path, key, value, &contexts.current)
        : key == "contexts"
            ? ParseServers(path, value, &contexts)
            : UnknownKey(path, "key", key, {"current", "contexts"});
    if (!taken.ok()) return taken;
  }
  if (!contexts.current.empty() &&
      contexts.servers.count(contexts.current) == 0) {
    return Wrong(path, absl::StrCat("current: contexts has no \"",
                                    contexts.current, "\""));
  }
  return contexts;
}

std::string TextOf(const Contexts& contexts) {
  Json servers = Json::object();
  for (const auto& [name, server] : contexts.servers) {
    Json json = Json::object();
    for (const ContextKey& key : kContextKeys) {
      if (!(server.*key.option).empty()) json[key.name] = server.*key.option;
    }
    servers[name] = std::move(json);
  }
  Json whole;
  if (!contexts.current.empty()) whole["current"] = contexts.current;
  whole["contexts"] = std::move(servers);
  return whole.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

// Waits until no other process changes the file.
absl::Status Lock(const Descriptor& lock, const std::string& path) {
  while (lock.number() < 0 || flock(lock.number(), LOCK_EX) != 0) {
    if (lock.number() < 0 || errno != EINTR) return FileError(path, errno);
  }
  return absl::OkStatus();
}

std::string FromEnvironment(const char* variable) {
  const char* const value = std::getenv(variable);
  return value == nullptr ? "" : value;
}

}  // namespace

std::string ContextsPath() {
  std::string path = FromEnvironment("REVISIT_CONTEXTS_FILE");
  if (!path.empty()) return path;
  const std::string folder = FromEnvironment("XDG_CONFIG_HOME");
  return absl::StrCat(folder.empty()
                          ? absl::StrCat(FromEnvironment("HOME"), "/.config")
                          : folder,
                      "/revisit/contexts.json");
}

std::string CheckContextName(const std::string& name) {
  constexpr std::size_t kMostBytes = 63;
  const bool fits = std::all_of(name.begin(), name.end(), [](char c) {
    return absl::ascii_isalnum(c) || c == '.' || c == '_' || c == '-';
  });
  if (fits && !name.empty() && name.size() <= kMostBytes &&
      absl::ascii_isalnum(name.front())) {
    return "";
  }
  return absl::StrCat("got \"", name, "\"; allowed are 1 to ", kMostBytes,
                      " letters, digits, '.', '_' and '-', a letter or digit "
                      "first");
}

std::string CheckServer(const ChannelOptions& server,
                        const std::string& dashes) {
  const auto requires_key = [&dashes](const char* key, const char* other) {
    return absl::StrCat(dashes, key, " requires ", dashes, other);
  };
  const bool has_certificate = !server.tls_certificate_file.empty();
  const bool has_key = !server.tls_key_file.empty();
  if (server.address.empty()) return dashes + "server is missing";
  if (has_certificate && !has_key) return requires_key("tls-cert", "tls-key");
  if (has_key && !has_certificate) return requires_key("tls-key", "tls-cert");
  if (has_certificate && server.tls_authorities_file.empty()) {
    return requires_key("tls-cert", "tls-ca");
  }
  return "";
}

absl::StatusOr<Contexts> ReadContexts(const std::string& path) {
  std::error_code error;
  if (!fs::exists(path, error) && !error) return Contexts();
  std::ifstream file(path, std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(file),
                         std::istreambuf_iterator<char>()};
  if (!file.is_open() || file.bad()) return FileError(path, errno);
  try {
    return Parse(path, Json::parse(text));
  } catch (const Json::parse_error& problem) {
    // The library's own name stands in brackets before the words.
    const std::string words = problem.what();
    const std::size_t bracket = words.find("] ");
    return Wrong(
        path, bracket == std::string::npos ? words : words.substr(bracket + 2));
  }
}

absl::Status ChangeContexts(
    const std::string& path,
    const std::function<absl::Status(Contexts*)>& change) {
  std::error_code error;
  // A link goes on leading to the file.
  const fs::path file = fs::weakly_canonical(path, error);
  if (error) {
    return LocalError(
        absl::UnknownError(absl::StrCat(path, ": ", error.message())));
  }
  fs::create_directories(file.parent_path(), error);
  if (error) {
    return LocalError(absl::UnknownError(
        absl::StrCat(file.parent_path().string(), ": ", error.message())));
  }
  // The file itself is replaced, so that a lock on it would hold nobody up.
  const std::string lock_path = file.string() + ".lock";
  const Descriptor lock(
      open(lock_path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600));
  if (absl::Status locked = Lock(lock, lock_path); !locked.ok()) return locked;
  auto contexts = ReadContexts(file.string());
  if (!contexts.ok()) return contexts.status();
  if (absl::Status changed = change(&*contexts); !changed.ok()) return changed;
  return ReplaceFile(file.string(), TextOf(*contexts));
}

absl::StatusOr<ChannelOptions> ServerOf(const Contexts& contexts,
                                        const std::string& name,
                                        const std::string& path) {
  const auto found = contexts.servers.find(name);
  if (found == contexts.servers.end()) {
    std::vector<std::string> known;
    for (const auto& [other, server] : contexts.servers) known.push_back(other);
    const std::string meant = Suggestion(name, known);
    return WithHint(LocalError(absl::NotFoundError(absl::StrCat(
                        path, " has no context \"", name, "\"",
                        meant.empty() ? "" : "; did you mean " + meant + "?"))),
                    known.empty()
                        ? absl::StrCat("revisit context set ", name,
                                       " --server ADDR makes it")
                        : absl::StrCat("it has ", absl::StrJoin(known, ", ")));
  }
  ChannelOptions server = found->second;
  const fs::path folder = fs::path(path).parent_path();
  for (const ContextKey& key : kContextKeys) {
    std::string& value = server.*key.option;
    if (key.is_file && !value.empty()) value = (folder / value).string();
  }
  return server;
}

}  // namespace revisit::client
