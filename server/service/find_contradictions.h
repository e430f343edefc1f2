// The handler of FindContradictions, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_FIND_CONTRADICTIONS_H_
#define REVISIT_SERVER_SERVICE_FIND_CONTRADICTIONS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status FindContradictions(const ServiceContext& service,
                                const UnaryCallPtr& call,
                                const v1::FindContradictionsRequest& request,
                                v1::FindContradictionsResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_FIND_CONTRADICTIONS_H_
