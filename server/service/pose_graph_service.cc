#include "server/service/pose_graph_service.h"

#include <memory>

#include "server/service/append_poses.h"
#include "server/service/check_calls.h"
#include "server/service/export_pose_graph.h"
#include "server/service/find_candidates.h"
#include "server/service/find_contradictions.h"
#include "server/service/group_calls.h"
#include "server/service/group_link_calls.h"
#include "server/service/group_member_calls.h"
#include "server/service/list_frame_transforms.h"
#include "server/service/list_poses.h"
#include "server/service/list_recordings.h"
#include "server/service/list_vehicles.h"
#include "server/service/pose_pair_calls.h"
#include "server/service/revise_poses.h"
#include "server/service/server_info.h"
#include "server/service/stream_poses.h"
#include "server/service/unary_call.h"
#include "server/service/vehicle_calls.h"
#include "server/service/watch_candidates.h"

namespace revisit::server {
namespace {

// Begins a unary call, which owns itself until it is done.
template <typename Request, typename Response>
grpc::ServerUnaryReactor* Begin(const ServiceContext& service,
                                const char* method,
                                UnaryHandler<Request, Response> handler,
                                grpc::CallbackServerContext* call_context,
                                const grpc::ByteBuffer* request,
                                grpc::ByteBuffer* response) {
  const auto call = std::make_shared<TypedCall<Request, Response>>(
      service, method, handler, call_context, request, response);
  call->Start();
  return call.get();
}

}  // namespace

grpc::ServerUnaryReactor* PoseGraphService::CreateVehicle(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "CreateVehicle", server::CreateVehicle, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::GetVehicle(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "GetVehicle", server::GetVehicle, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListVehicles(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListVehicles", server::ListVehicles, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::UpdateVehicle(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "UpdateVehicle", server::UpdateVehicle, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteVehicle(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteVehicle", server::DeleteVehicle, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::AppendPoses(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "AppendPoses", server::AppendPoses, call, request,
               response);
}

grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>*
PoseGraphService::StreamPoses(grpc::CallbackServerContext* call) {
  return StartPoseStream(call, service_);
}

grpc::ServerUnaryReactor* PoseGraphService::FindCandidates(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "FindCandidates", server::FindCandidates, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::AddLoopClosure(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "AddLoopClosure", server::AddLoopClosure, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListLoopClosures(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListLoopClosures", server::ListLoopClosures, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteLoopClosure(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteLoopClosure", server::DeleteLoopClosure, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::FindContradictions(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "FindContradictions", server::FindContradictions, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::RejectCandidate(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "RejectCandidate", server::RejectCandidate, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListRejectedCandidates(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListRejectedCandidates",
               server::ListRejectedCandidates, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteRejectedCandidate(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteRejectedCandidate",
               server::DeleteRejectedCandidate, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListDeletedPosePairs(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListDeletedPosePairs", server::ListDeletedPosePairs,
               call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::GetCheck(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "GetCheck", server::GetCheck, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListChecks(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListChecks", server::ListChecks, call, request,
               response);
}

grpc::ServerWriteReactor<grpc::ByteBuffer>* PoseGraphService::WatchCandidates(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request) {
  return StartWatch(call, service_, request);
}

grpc::ServerReadReactor<grpc::ByteBuffer>* PoseGraphService::RevisePoses(
    grpc::CallbackServerContext* call, grpc::ByteBuffer* response) {
  return StartRevision(call, service_, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListPoses(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListPoses", server::ListPoses, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListRecordings(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListRecordings", server::ListRecordings, call,
               request, response);
}

grpc::ServerWriteReactor<grpc::ByteBuffer>* PoseGraphService::ExportPoseGraph(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request) {
  return StartExport(call, service_, request);
}

grpc::ServerUnaryReactor* PoseGraphService::CreateGroup(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "CreateGroup", server::CreateGroup, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::GetGroup(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "GetGroup", server::GetGroup, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListGroups(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListGroups", server::ListGroups, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::UpdateGroup(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "UpdateGroup", server::UpdateGroup, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteGroup(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteGroup", server::DeleteGroup, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::AddGroupMember(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "AddGroupMember", server::AddMemberToGroup, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::UpdateGroupMember(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "UpdateGroupMember", server::UpdateGroupMember, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::RemoveGroupMember(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "RemoveGroupMember", server::RemoveMemberFromGroup,
               call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListGroupMembers(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListGroupMembers", server::ListGroupMembers, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::AddInterVehicleLoopClosure(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "AddInterVehicleLoopClosure",
               server::AddInterVehicleLoopClosure, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListInterVehicleLoopClosures(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListInterVehicleLoopClosures",
               server::ListInterVehicleLoopClosures, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteInterVehicleLoopClosure(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteInterVehicleLoopClosure",
               server::DeleteInterVehicleLoopClosure, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::RejectInterVehicleCandidate(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "RejectInterVehicleCandidate",
               server::RejectInterVehicleCandidate, call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListInterVehicleRejectedCandidates(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListInterVehicleRejectedCandidates",
               server::ListInterVehicleRejectedCandidates, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteInterVehicleRejectedCandidate(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "DeleteInterVehicleRejectedCandidate",
               server::DeleteInterVehicleRejectedCandidate, call, request,
               response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListFrameTransforms(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "ListFrameTransforms", server::ListFrameTransforms,
               call, request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::AcceptDataLoss(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "AcceptDataLoss", server::AcceptDataLoss, call,
               request, response);
}

grpc::ServerUnaryReactor* PoseGraphService::GetServerInfo(
    grpc::CallbackServerContext* call, const grpc::ByteBuffer* request,
    grpc::ByteBuffer* response) {
  return Begin(service_, "GetServerInfo", server::GetServerInfo, call, request,
               response);
}

}  // namespace revisit::server
