// The one place where a status becomes gRPC's.
#ifndef REVISIT_SERVER_BASE_STATUS_GRPC_H_
#define REVISIT_SERVER_BASE_STATUS_GRPC_H_

#include "absl/status/status.h"
#include "grpcpp/support/status.h"

namespace revisit::server {

// Same code and message; the payloads become the details of a
// google.rpc.Status. A status that brings no ErrorInfo is given one whose
// reason follows from the code: INTERNAL where nothing better can be said.
// UNKNOWN becomes INTERNAL.
grpc::Status ToGrpcStatus(const absl::Status& status);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_STATUS_GRPC_H_
