// The handlers of revisit.v1.PoseGraphService. Each decodes, calls a session,
// and encodes; none blocks a thread of gRPC's.
#ifndef REVISIT_SERVER_POSE_GRAPH_SERVICE_H_
#define REVISIT_SERVER_POSE_GRAPH_SERVICE_H_

#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "server/service_context.h"

namespace revisit::server {

class PoseGraphService final : public v1::PoseGraphService::CallbackService {
 public:
  explicit PoseGraphService(const ServiceContext& context)
      : context_(context) {}

  grpc::ServerUnaryReactor* CreateVehicle(
      grpc::CallbackServerContext* call,
      const v1::CreateVehicleRequest* request,
      v1::CreateVehicleResponse* response) override;
  grpc::ServerUnaryReactor* GetVehicle(
      grpc::CallbackServerContext* call, const v1::GetVehicleRequest* request,
      v1::GetVehicleResponse* response) override;
  grpc::ServerUnaryReactor* ListVehicles(
      grpc::CallbackServerContext* call, const v1::ListVehiclesRequest* request,
      v1::ListVehiclesResponse* response) override;
  grpc::ServerUnaryReactor* UpdateVehicle(
      grpc::CallbackServerContext* call,
      const v1::UpdateVehicleRequest* request,
      v1::UpdateVehicleResponse* response) override;
  grpc::ServerUnaryReactor* DeleteVehicle(
      grpc::CallbackServerContext* call,
      const v1::DeleteVehicleRequest* request,
      v1::DeleteVehicleResponse* response) override;
  grpc::ServerUnaryReactor* AppendPoses(
      grpc::CallbackServerContext* call, const v1::AppendPosesRequest* request,
      v1::AppendPosesResponse* response) override;
  grpc::ServerBidiReactor<v1::StreamPosesRequest, v1::StreamPosesResponse>*
  StreamPoses(grpc::CallbackServerContext* call) override;
  grpc::ServerUnaryReactor* FindCandidates(
      grpc::CallbackServerContext* call,
      const v1::FindCandidatesRequest* request,
      v1::FindCandidatesResponse* response) override;
  grpc::ServerUnaryReactor* AddLoopClosure(
      grpc::CallbackServerContext* call,
      const v1::AddLoopClosureRequest* request,
      v1::AddLoopClosureResponse* response) override;
  grpc::ServerUnaryReactor* ListLoopClosures(
      grpc::CallbackServerContext* call,
      const v1::ListLoopClosuresRequest* request,
      v1::ListLoopClosuresResponse* response) override;
  grpc::ServerUnaryReactor* DeleteLoopClosure(
      grpc::CallbackServerContext* call,
      const v1::DeleteLoopClosureRequest* request,
      v1::DeleteLoopClosureResponse* response) override;
  grpc::ServerUnaryReactor* RejectCandidate(
      grpc::CallbackServerContext* call,
      const v1::RejectCandidateRequest* request,
      v1::RejectCandidateResponse* response) override;
  grpc::ServerUnaryReactor* ListRejectedCandidates(
      grpc::CallbackServerContext* call,
      const v1::ListRejectedCandidatesRequest* request,
      v1::ListRejectedCandidatesResponse* response) override;
  grpc::ServerUnaryReactor* DeleteRejectedCandidate(
      grpc::CallbackServerContext* call,
      const v1::DeleteRejectedCandidateRequest* request,
      v1::DeleteRejectedCandidateResponse* response) override;
  grpc::ServerReadReactor<v1::RevisePosesRequest>* RevisePoses(
      grpc::CallbackServerContext* call,
      v1::RevisePosesResponse* response) override;
  grpc::ServerUnaryReactor* ListPoses(grpc::CallbackServerContext* call,
                                      const v1::ListPosesRequest* request,
                                      v1::ListPosesResponse* response) override;
  grpc::ServerWriteReactor<v1::ExportPoseGraphResponse>* ExportPoseGraph(
      grpc::CallbackServerContext* call,
      const v1::ExportPoseGraphRequest* request) override;
  grpc::ServerUnaryReactor* AcceptDataLoss(
      grpc::CallbackServerContext* call,
      const v1::AcceptDataLossRequest* request,
      v1::AcceptDataLossResponse* response) override;
  grpc::ServerUnaryReactor* GetServerInfo(
      grpc::CallbackServerContext* call,
      const v1::GetServerInfoRequest* request,
      v1::GetServerInfoResponse* response) override;

 private:
  // Runs the handler of a unary call. `handle` is given the call and either
  // returns an error, which ends it, or OK, and then sees to it that the call
  // is finished, once, from whatever thread.
  template <typename Handle>
  grpc::ServerUnaryReactor* Unary(grpc::CallbackServerContext* context,
                                  const char* method, Handle handle);

  const ServiceContext context_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_POSE_GRAPH_SERVICE_H_
