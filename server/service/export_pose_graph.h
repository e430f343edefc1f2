// The reactor of ExportPoseGraph.
#ifndef REVISIT_SERVER_SERVICE_EXPORT_POSE_GRAPH_H_
#define REVISIT_SERVER_SERVICE_EXPORT_POSE_GRAPH_H_

#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Starts the call, which owns itself until it is done. The service context is
// copied; the request, of type ExportPoseGraphRequest, is read at once.
grpc::ServerWriteReactor<grpc::ByteBuffer>* StartExport(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const grpc::ByteBuffer* request);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_EXPORT_POSE_GRAPH_H_
