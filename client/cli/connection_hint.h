// What may be wrong with a connection, where gRPC does not say it.
#ifndef REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
#define REVISIT_CLIENT_CLI_CONNECTION_HINT_H_

#include <string>

#include "absl/status/status.h"
#include "client/revisit/channel.h"

namespace revisit::client {

// A question to whoever gave the flags, in brackets, if a server was there and
// no connection came about. Otherwise empty.
std::string ConnectionHint(const absl::Status& status,
                           const ChannelOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
