// The handler of ListPoses, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_LIST_POSES_H_
#define REVISIT_SERVER_SERVICE_LIST_POSES_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status ListPoses(const ServiceContext& service, const UnaryCallPtr& call,
                       const v1::ListPosesRequest& request,
                       v1::ListPosesResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_LIST_POSES_H_
