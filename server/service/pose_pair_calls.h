// The handlers of calls about pairs of poses: loop closures, and candidates
// that were rejected. They are UnaryHandlers (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_
#define REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status AddLoopClosure(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::AddLoopClosureRequest& request,
                            v1::AddLoopClosureResponse* response);

absl::Status ListLoopClosures(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::ListLoopClosuresRequest& request,
                              v1::ListLoopClosuresResponse* response);

absl::Status DeleteLoopClosure(const ServiceContext& service,
                               const UnaryCallPtr& call,
                               const v1::DeleteLoopClosureRequest& request,
                               v1::DeleteLoopClosureResponse* response);

absl::Status RejectCandidate(const ServiceContext& service,
                             const UnaryCallPtr& call,
                             const v1::RejectCandidateRequest& request,
                             v1::RejectCandidateResponse* response);

absl::Status ListRejectedCandidates(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListRejectedCandidatesRequest& request,
    v1::ListRejectedCandidatesResponse* response);

absl::Status DeleteRejectedCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteRejectedCandidateRequest& request,
    v1::DeleteRejectedCandidateResponse* response);

absl::Status ListDeletedPosePairs(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListDeletedPosePairsRequest& request,
    v1::ListDeletedPosePairsResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_
