// Hints at what may be wrong with a connection, where gRPC does not say it.
#ifndef REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
#define REVISIT_CLIENT_CLI_CONNECTION_HINT_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/connection_flags.h"

namespace revisit::client {

// A question in brackets to whoever gave the flags, if there was a server but
// no connection came about; and which context chose the server, if one did and
// the error concerns the connection or the credentials. Otherwise empty.
std::string ConnectionHint(const absl::Status& status,
                           const ChosenServer& server);

// Which context chose the server, and where it is written; empty if none did.
std::string ContextHint(const ChosenServer& server);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
