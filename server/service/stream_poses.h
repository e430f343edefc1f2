// The reactor of StreamPoses.
#ifndef REVISIT_SERVER_SERVICE_STREAM_POSES_H_
#define REVISIT_SERVER_SERVICE_STREAM_POSES_H_

#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Starts the stream, which owns itself until it is done. The service context is
// copied.
grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>* StartPoseStream(
    grpc::CallbackServerContext* call, const ServiceContext& context);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_STREAM_POSES_H_
