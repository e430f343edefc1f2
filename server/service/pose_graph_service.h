// The methods of revisit.v1.PoseGraphService. Their handlers are in files of
// their own, by what they are about. Each decodes, calls a session or the
// editor of groups, and encodes; none blocks a thread of gRPC.
//
// A new method has, besides its message types, a handler and its lines here: a
// row in security/method_rules.cc, which says who may call it; one in
// telemetry/audit_log.cc, if it changes something; a route of
// deploy/cluster/envoy.yaml (made by update_routing.py beside it, which has a
// list of those that are about no vehicle); and its call
// in client/revisit/client.h and client/python/revisit/_calls.py.
#ifndef REVISIT_SERVER_SERVICE_POSE_GRAPH_SERVICE_H_
#define REVISIT_SERVER_SERVICE_POSE_GRAPH_SERVICE_H_

#include "grpcpp/support/byte_buffer.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Calls get their messages as bytes, for two reasons: a message that is no
// protobuf is answered as other mistakes of callers are, and no message of a
// caller who is not admitted is parsed.
namespace service_internal {

using Service = v1::PoseGraphService;
template <typename Base>
using WithVehicles = Service::WithRawCallbackMethod_CreateVehicle<
    Service::WithRawCallbackMethod_GetVehicle<
        Service::WithRawCallbackMethod_ListVehicles<
            Service::WithRawCallbackMethod_UpdateVehicle<
                Service::WithRawCallbackMethod_DeleteVehicle<Base>>>>>;
template <typename Base>
using WithPoses = Service::WithRawCallbackMethod_AppendPoses<
    Service::WithRawCallbackMethod_StreamPoses<
        Service::WithRawCallbackMethod_RevisePoses<
            Service::WithRawCallbackMethod_ListPoses<
                Service::WithRawCallbackMethod_ListRecordings<
                    Service::WithRawCallbackMethod_ExportPoseGraph<Base>>>>>>;
template <typename Base>
using WithLoopClosures = Service::WithRawCallbackMethod_AddLoopClosure<
    Service::WithRawCallbackMethod_ListLoopClosures<
        Service::WithRawCallbackMethod_DeleteLoopClosure<
            Service::WithRawCallbackMethod_FindContradictions<Base>>>>;
template <typename Base>
using WithCandidates = Service::WithRawCallbackMethod_FindCandidates<
    Service::WithRawCallbackMethod_RejectCandidate<
        Service::WithRawCallbackMethod_ListRejectedCandidates<
            Service::WithRawCallbackMethod_DeleteRejectedCandidate<
                Service::WithRawCallbackMethod_ListDeletedPosePairs<Base>>>>>;
template <typename Base>
using WithChecks = Service::WithRawCallbackMethod_GetCheck<
    Service::WithRawCallbackMethod_ListChecks<
        Service::WithRawCallbackMethod_WatchCandidates<Base>>>;
template <typename Base>
using WithGroups = Service::WithRawCallbackMethod_CreateGroup<
    Service::WithRawCallbackMethod_GetGroup<
        Service::WithRawCallbackMethod_ListGroups<
            Service::WithRawCallbackMethod_UpdateGroup<
                Service::WithRawCallbackMethod_DeleteGroup<Base>>>>>;
template <typename Base>
using WithMembers = Service::WithRawCallbackMethod_AddGroupMember<
    Service::WithRawCallbackMethod_UpdateGroupMember<
        Service::WithRawCallbackMethod_RemoveGroupMember<
            Service::WithRawCallbackMethod_ListGroupMembers<Base>>>>;
template <typename Base>
using WithGroupRejections =
    Service::WithRawCallbackMethod_RejectInterVehicleCandidate<
        Service::WithRawCallbackMethod_ListInterVehicleRejectedCandidates<
            Service::WithRawCallbackMethod_DeleteInterVehicleRejectedCandidate<
                Base>>>;
template <typename Base>
using WithGroupLinks =
    Service::WithRawCallbackMethod_AddInterVehicleLoopClosure<
        Service::WithRawCallbackMethod_ListInterVehicleLoopClosures<
            Service::WithRawCallbackMethod_DeleteInterVehicleLoopClosure<
                Service::WithRawCallbackMethod_ListFrameTransforms<Base>>>>;
template <typename Base>
using WithOperations = Service::WithRawCallbackMethod_AcceptDataLoss<
    Service::WithRawCallbackMethod_GetServerInfo<Base>>;
using AllMethods = WithVehicles<WithPoses<WithLoopClosures<
    WithCandidates<WithChecks<WithGroups<WithMembers<WithGroupLinks<
        WithGroupRejections<WithOperations<Service::Service>>>>>>>>>>;

}  // namespace service_internal

class PoseGraphService final : public service_internal::AllMethods {
 public:
  explicit PoseGraphService(const ServiceContext& service)
      : service_(service) {}

  grpc::ServerUnaryReactor* CreateVehicle(grpc::CallbackServerContext* call,
                                          const grpc::ByteBuffer* request,
                                          grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* GetVehicle(grpc::CallbackServerContext* call,
                                       const grpc::ByteBuffer* request,
                                       grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListVehicles(grpc::CallbackServerContext* call,
                                         const grpc::ByteBuffer* request,
                                         grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* UpdateVehicle(grpc::CallbackServerContext* call,
                                          const grpc::ByteBuffer* request,
                                          grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteVehicle(grpc::CallbackServerContext* call,
                                          const grpc::ByteBuffer* request,
                                          grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* AppendPoses(grpc::CallbackServerContext* call,
                                        const grpc::ByteBuffer* request,
                                        grpc::ByteBuffer* response) override;
  grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>* StreamPoses(
      grpc::CallbackServerContext* call) override;
  grpc::ServerUnaryReactor* FindCandidates(grpc::CallbackServerContext* call,
                                           const grpc::ByteBuffer* request,
                                           grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* AddLoopClosure(grpc::CallbackServerContext* call,
                                           const grpc::ByteBuffer* request,
                                           grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListLoopClosures(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteLoopClosure(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* FindContradictions(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* RejectCandidate(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListRejectedCandidates(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteRejectedCandidate(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListDeletedPosePairs(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* GetCheck(grpc::CallbackServerContext* call,
                                     const grpc::ByteBuffer* request,
                                     grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListChecks(grpc::CallbackServerContext* call,
                                       const grpc::ByteBuffer* request,
                                       grpc::ByteBuffer* response) override;
  grpc::ServerWriteReactor<grpc::ByteBuffer>* WatchCandidates(
      grpc::CallbackServerContext* call,
      const grpc::ByteBuffer* request) override;
  grpc::ServerReadReactor<grpc::ByteBuffer>* RevisePoses(
      grpc::CallbackServerContext* call, grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListPoses(grpc::CallbackServerContext* call,
                                      const grpc::ByteBuffer* request,
                                      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListRecordings(grpc::CallbackServerContext* call,
                                           const grpc::ByteBuffer* request,
                                           grpc::ByteBuffer* response) override;
  grpc::ServerWriteReactor<grpc::ByteBuffer>* ExportPoseGraph(
      grpc::CallbackServerContext* call,
      const grpc::ByteBuffer* request) override;
  grpc::ServerUnaryReactor* CreateGroup(grpc::CallbackServerContext* call,
                                        const grpc::ByteBuffer* request,
                                        grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* GetGroup(grpc::CallbackServerContext* call,
                                     const grpc::ByteBuffer* request,
                                     grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListGroups(grpc::CallbackServerContext* call,
                                       const grpc::ByteBuffer* request,
                                       grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* UpdateGroup(grpc::CallbackServerContext* call,
                                        const grpc::ByteBuffer* request,
                                        grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteGroup(grpc::CallbackServerContext* call,
                                        const grpc::ByteBuffer* request,
                                        grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* AddGroupMember(grpc::CallbackServerContext* call,
                                           const grpc::ByteBuffer* request,
                                           grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* UpdateGroupMember(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* RemoveGroupMember(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListGroupMembers(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* AddInterVehicleLoopClosure(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListInterVehicleLoopClosures(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteInterVehicleLoopClosure(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* RejectInterVehicleCandidate(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListInterVehicleRejectedCandidates(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* DeleteInterVehicleRejectedCandidate(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* ListFrameTransforms(
      grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
      grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* AcceptDataLoss(grpc::CallbackServerContext* call,
                                           const grpc::ByteBuffer* request,
                                           grpc::ByteBuffer* response) override;
  grpc::ServerUnaryReactor* GetServerInfo(grpc::CallbackServerContext* call,
                                          const grpc::ByteBuffer* request,
                                          grpc::ByteBuffer* response) override;

 private:
  const ServiceContext service_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_POSE_GRAPH_SERVICE_H_
