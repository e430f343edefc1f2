// Internal to the client library: the one place where a grpc::Status becomes an
// absl::Status.
#ifndef REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_
#define REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_

#include "absl/status/status.h"

namespace grpc {
class Status;
}

namespace revisit::client {

// Code, message and every detail, each as a payload under its type URL.
absl::Status FromGrpc(const grpc::Status& status);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_STATUS_FROM_GRPC_H_
