// The handlers of the loop closures and rejected candidates between the members
// of a group: each is a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_GROUP_LINK_CALLS_H_
#define REVISIT_SERVER_SERVICE_GROUP_LINK_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status AddInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::AddInterVehicleLoopClosureRequest& request,
    v1::AddInterVehicleLoopClosureResponse* response);

absl::Status ListInterVehicleLoopClosures(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListInterVehicleLoopClosuresRequest& request,
    v1::ListInterVehicleLoopClosuresResponse* response);

absl::Status DeleteInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteInterVehicleLoopClosureRequest& request,
    v1::DeleteInterVehicleLoopClosureResponse* response);

absl::Status RejectInterVehicleCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::RejectInterVehicleCandidateRequest& request,
    v1::RejectInterVehicleCandidateResponse* response);

absl::Status ListInterVehicleRejectedCandidates(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListInterVehicleRejectedCandidatesRequest& request,
    v1::ListInterVehicleRejectedCandidatesResponse* response);

absl::Status DeleteInterVehicleRejectedCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteInterVehicleRejectedCandidateRequest& request,
    v1::DeleteInterVehicleRejectedCandidateResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_LINK_CALLS_H_
