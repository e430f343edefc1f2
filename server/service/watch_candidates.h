// WatchCandidates.
#ifndef REVISIT_SERVER_SERVICE_WATCH_CANDIDATES_H_
#define REVISIT_SERVER_SERVICE_WATCH_CANDIDATES_H_

#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Begins a watch, which owns itself until it is done. The bytes of the request
// live until this returns.
grpc::ServerWriteReactor<grpc::ByteBuffer>* StartWatch(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const grpc::ByteBuffer* request);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_WATCH_CANDIDATES_H_
