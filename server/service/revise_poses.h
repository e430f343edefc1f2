// The reactor of RevisePoses.
#ifndef REVISIT_SERVER_SERVICE_REVISE_POSES_H_
#define REVISIT_SERVER_SERVICE_REVISE_POSES_H_

#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Starts the call, which owns itself until it is done. The service context is
// copied; `response` is filled before the call finishes.
grpc::ServerReadReactor<grpc::ByteBuffer>* StartRevision(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    grpc::ByteBuffer* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_REVISE_POSES_H_
