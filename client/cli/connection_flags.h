// Which server a command asks: by flags, the environment, a context, or where a
// server listens by default.
#ifndef REVISIT_CLIENT_CLI_CONNECTION_FLAGS_H_
#define REVISIT_CLIENT_CLI_CONNECTION_FLAGS_H_

#include <string>

#include "absl/status/statusor.h"
#include "client/cli/flags.h"
#include "client/revisit/channel.h"

namespace revisit::client {

// Where a server listens by default.
inline constexpr char kDefaultServer[] = "127.0.0.1:50051";

// The values of the flags, or of their variables.
struct ConnectionFlags {
  std::string context;
  ChannelOptions server;
};

// Adds the flags to the program, so that every command takes them.
void AddConnectionFlags(const Command& program, ConnectionFlags* flags);

struct ChosenServer {
  ChannelOptions options;
  // The name of the context; empty if none counts.
  std::string context;
  // The file that has the context.
  std::string contexts_path;
  // The flag or variable that chose the address, such as "REVISIT_CONTEXT", or
  // words for people where neither did.
  std::string chosen_by;
};

// Chooses by the first of these that there is: --server or --context,
// REVISIT_SERVER or REVISIT_CONTEXT, the current context, the default. An
// address from a flag or a variable leaves contexts aside. What a context says
// of TLS and of the token is replaced by the flags, and by the variables unless
// the context itself was named by a flag: those belong to another server then.
//
// A UsageError (terminal.h) if two servers are named at once or TLS is not
// whole. An error of this machine if the file of contexts is needed and wrong,
// or has no such context.
absl::StatusOr<ChosenServer> ChooseServer(const Command& program,
                                          const ConnectionFlags& flags);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONNECTION_FLAGS_H_
