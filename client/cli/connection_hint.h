// Connections whose errors say what may be wrong, where gRPC does not.
#ifndef REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
#define REVISIT_CLIENT_CLI_CONNECTION_HINT_H_

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/cli/connection_flags.h"

namespace revisit::client {

// A question in brackets to whoever gave the flags, if there was a server but
// no connection came about; and which context chose the server, if one did and
// the error concerns the connection or the credentials. Otherwise empty.
std::string ConnectionHint(const absl::Status& status,
                           const ChosenServer& server);

// A channel to the server, as MakeChannel() has it. An error is one of this
// machine, such as a certificate that cannot be read, and names the context.
absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannelTo(
    const ChosenServer& server);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
