// Internal to the client library: the one place where a grpc::Status becomes an
// absl::Status.
#ifndef REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_
#define REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_

#include "absl/status/status.h"

namespace grpc {
class Status;
}

namespace revisit::client {

// Code, message and details, each as a payload under its type URL. A detail
// that is none of google.rpc is left out: payloads of other names are this
// program's own, and no server may speak by them.
absl::Status FromGrpc(const grpc::Status& status);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_
