// The reactor of ExportPoseGraph.
#ifndef REVISIT_SERVER_EXPORT_POSE_GRAPH_H_
#define REVISIT_SERVER_EXPORT_POSE_GRAPH_H_

#include "grpcpp/server_context.h"
#include "grpcpp/support/server_callback.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service_context.h"

namespace revisit::server {

// Starts the call, which owns itself until it is done. Context and request are
// copied as far as needed.
grpc::ServerWriteReactor<v1::ExportPoseGraphResponse>* StartExport(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const v1::ExportPoseGraphRequest& request);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_EXPORT_POSE_GRAPH_H_
