// Named servers, which a file of the user keeps, so that a command line names
// one by a word.
#ifndef REVISIT_CLIENT_CLI_CONTEXTS_H_
#define REVISIT_CLIENT_CLI_CONTEXTS_H_

#include <functional>
#include <map>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/channel.h"

namespace revisit::client {

// One thing that a context says of its server.
struct ContextKey {
  // In the file, and behind the dashes of the flag.
  const char* name;
  // In JSON that is printed.
  const char* json_name;
  std::string ChannelOptions::*option;
  bool is_file;
};

inline constexpr ContextKey kContextKeys[] = {
    {"server", "server", &ChannelOptions::address, false},
    {"tls-ca", "tlsCa", &ChannelOptions::tls_authorities_file, true},
    {"tls-cert", "tlsCert", &ChannelOptions::tls_certificate_file, true},
    {"tls-key", "tlsKey", &ChannelOptions::tls_key_file, true},
    {"token-file", "tokenFile", &ChannelOptions::token_file, true}};

struct Contexts {
  // The one that counts where no other is named; empty for none.
  std::string current;
  // By name, with paths of files as they are written in the file.
  std::map<std::string, ChannelOptions> servers;
};

// The file that REVISIT_CONTEXTS_FILE names, otherwise revisit/contexts.json in
// XDG_CONFIG_HOME, otherwise in ~/.config.
std::string ContextsPath();

// Says what is wrong with the name of a context; empty if nothing is.
std::string CheckContextName(const std::string& name);

// Says what is wrong with the settings of a server taken together; empty if
// nothing is. `dashes` stand before the keys that it names.
std::string CheckServer(const ChannelOptions& server,
                        const std::string& dashes = "");

// {"current": NAME, "contexts": {NAME: {"server": ADDR, "tls-ca": FILE, ...}}}.
// Without the file there are no contexts. An error of this machine names the
// file and the key that is wrong; a key that is not known is wrong.
absl::StatusOr<Contexts> ReadContexts(const std::string& path);

// Lets `change` alter what the file holds. The file, readable by its owner
// alone, is replaced as a whole if `change` answers OK. Of changes that several
// processes make at the same time none is lost.
absl::Status ChangeContexts(
    const std::string& path,
    const std::function<absl::Status(Contexts*)>& change);

// The server of this context; its files that are not absolute lie beside the
// file of `path`. An error of this machine, with the names that there are, if
// there is none.
absl::StatusOr<ChannelOptions> ServerOf(const Contexts& contexts,
                                        const std::string& name,
                                        const std::string& path);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONTEXTS_H_
