// The handler of FindCandidates, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_FIND_CANDIDATES_H_
#define REVISIT_SERVER_SERVICE_FIND_CANDIDATES_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status FindCandidates(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::FindCandidatesRequest& request,
                            v1::FindCandidatesResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_FIND_CANDIDATES_H_
