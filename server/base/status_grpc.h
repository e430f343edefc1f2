// The one place where a status becomes a status of gRPC.
#ifndef REVISIT_SERVER_BASE_STATUS_GRPC_H_
#define REVISIT_SERVER_BASE_STATUS_GRPC_H_

#include "absl/status/status.h"
#include "grpcpp/support/status.h"

namespace revisit::server {

// Keeps code and message; the payloads become the details of a
// google.rpc.Status, its ErrorInfo first. Callers are told errors that are
// Named().
grpc::Status ToGrpcStatus(const absl::Status& status);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_STATUS_GRPC_H_
