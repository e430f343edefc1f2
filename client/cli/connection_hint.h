// Hints at what may be wrong with a connection, where gRPC does not say it.
#ifndef REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
#define REVISIT_CLIENT_CLI_CONNECTION_HINT_H_

#include <string>

#include "absl/status/status.h"
#include "client/revisit/channel.h"

namespace revisit::client {

// A question in brackets to whoever gave the flags, if there was a server but
// no connection came about; otherwise empty.
std::string ConnectionHint(const absl::Status& status,
                           const ChannelOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONNECTION_HINT_H_
