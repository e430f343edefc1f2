// The handler of ListPoses.
#ifndef REVISIT_SERVER_SERVICE_LIST_POSES_H_
#define REVISIT_SERVER_SERVICE_LIST_POSES_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

// Finishes the call, unless it returns an error. Request and response live as
// long as the call.
absl::Status ListPoses(const ServiceContext& context, const UnaryCallPtr& call,
                       const v1::ListPosesRequest& request,
                       v1::ListPosesResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_LIST_POSES_H_
