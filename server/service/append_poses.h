// The handler of AppendPoses, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_APPEND_POSES_H_
#define REVISIT_SERVER_SERVICE_APPEND_POSES_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status AppendPoses(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::AppendPosesRequest& request,
                         v1::AppendPosesResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_APPEND_POSES_H_
