// The handler of ListFrameTransforms, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_LIST_FRAME_TRANSFORMS_H_
#define REVISIT_SERVER_SERVICE_LIST_FRAME_TRANSFORMS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status ListFrameTransforms(const ServiceContext& service,
                                 const UnaryCallPtr& call,
                                 const v1::ListFrameTransformsRequest& request,
                                 v1::ListFrameTransformsResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_LIST_FRAME_TRANSFORMS_H_
