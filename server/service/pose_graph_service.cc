#include "server/service/pose_graph_service.h"

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/settings.h"
#include "server/base/status.h"
#include "server/conversion/answers.h"
#include "server/conversion/names.h"
#include "server/conversion/pose_inspection.h"
#include "server/conversion/poses.h"
#include "server/conversion/vehicle_labels.h"
#include "server/conversion/vehicle_settings.h"
#include "server/service/export_pose_graph.h"
#include "server/service/find_candidates.h"
#include "server/service/list_poses.h"
#include "server/service/list_vehicles.h"
#include "server/service/message_bytes.h"
#include "server/service/pose_pair_calls.h"
#include "server/service/revise_poses.h"
#include "server/service/stream_poses.h"
#include "server/service/unary_call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/sessions/vehicle_uid.h"
#include "server/storage/records.h"
#include "server/storage/storage.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// The part of a vehicle that a caller gets who changed the vehicle but may not
// read it: which one it is. The caller's own settings are added to that.
v1::Vehicle IdentityOf(const v1::Vehicle& vehicle) {
  v1::Vehicle identity;
  identity.set_name(vehicle.name());
  identity.set_uid(vehicle.uid());
  return identity;
}

bool MayRead(const UnaryCall& call, const std::string& vehicle_id) {
  return call.rights().caller().May(Verb::kRead, vehicle_id);
}

// Creates a vehicle, or finds the one of that name that is there. A vehicle
// that is deleted between the two is created anew: a creation never finds
// nothing.
void CreateOrFind(
    Fleet* fleet, const UnaryCallPtr& call, const std::string& id,
    const VehicleConfig& config, const CreateCallback& created,
    const std::function<void(absl::StatusOr<VehicleView>)>& found) {
  fleet->Create(id, config, [=](const absl::StatusOr<CreatedVehicle>& made) {
    if (!absl::IsAlreadyExists(made.status())) {
      created(made);
      return;
    }
    fleet->Session(id)->Read([=](const absl::StatusOr<VehicleView>& view) {
      if (absl::IsNotFound(view.status()) && !call->given_up()) {
        CreateOrFind(fleet, call, id, config, created, found);
      } else {
        found(view);
      }
    });
  });
}

// The batch of an AppendPoses call. Request and response live as long as the
// call.
class UnaryAppend final : public AppendObserver {
 public:
  UnaryAppend(UnaryCallPtr call, const v1::AppendPosesRequest* request,
              v1::AppendPosesResponse* response, ServiceCounters* counts)
      : call_(std::move(call)),
        request_(request),
        response_(response),
        counts_(counts) {}

  // The batch may have waited past its caller's deadline.
  absl::Status StillWanted() const override {
    return call_->given_up() ? call_->GivenUpStatus() : absl::OkStatus();
  }

  void OnDecoded(const VehicleConfig& config,
                 const std::vector<core::PoseSample>& samples) override {
    if (samples.front().sequence != 1) return;
    PoseInspector(config.frame).Look(samples, &warnings_);
  }

  void OnDurable(const absl::StatusOr<Acknowledgement>& result) override {
    const auto poses = static_cast<std::uint64_t>(request_->poses_size());
    if (result.ok()) {
      counts_->Acknowledged(poses, result->accepted_poses,
                            std::chrono::steady_clock::now() - start_);
      EncodeAck(*result, response_->mutable_ack());
      response_->mutable_ack()->mutable_warnings()->MergeFrom(warnings_);
    } else {
      counts_->Refused(poses, result.status());
    }
    call_->End(result.status());
  }

 private:
  const UnaryCallPtr call_;
  const v1::AppendPosesRequest* const request_;
  v1::AppendPosesResponse* const response_;
  ServiceCounters* const counts_;
  const std::chrono::steady_clock::time_point start_ =
      std::chrono::steady_clock::now();
  PoseInspector::Warnings warnings_;
};

}  // namespace

template <typename Request, typename Response, typename Handle>
grpc::ServerUnaryReactor* PoseGraphService::Unary(
    grpc::CallbackServerContext* context, const char* method,
    const grpc::ByteBuffer* request, grpc::ByteBuffer* response,
    Handle handle) {
  const auto call = std::make_shared<TypedCall<Request, Response, Handle>>(
      context, method, context_, request, response, std::move(handle));
  call->Start();
  return call.get();
}

grpc::ServerUnaryReactor* PoseGraphService::CreateVehicle(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::CreateVehicleRequest, v1::CreateVehicleResponse>(
      call_context, "CreateVehicle", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::CreateVehicleRequest* request,
          v1::CreateVehicleResponse* response) {
        const std::string& id = request->vehicle_id();
        if (absl::Status status = CheckId(id, kRequest.Field("vehicle_id"));
            !status.ok()) {
          return status;
        }
        if (absl::Status status = call->ChooseVehicle(id); !status.ok()) {
          return status;
        }
        const FieldPath field = kRequest.Field("vehicle");
        absl::StatusOr<VehicleConfig> config = DecodeSettings(
            request->vehicle().settings(), field.Field("settings"));
        if (!config.ok()) return config.status();
        const LabelsMask all = {true, true, {}};
        if (absl::Status status =
                UpdateLabels(request->vehicle(), all, field, &*config);
            !status.ok()) {
          return status;
        }
        config->create_time_ns = NowNanoseconds();
        config->uid = NewVehicleUid();
        const VehicleConfig requested = *config;
        // `vehicle`: its view, or its record.
        const auto encode = [=](const auto& vehicle) {
          v1::Vehicle* const answer = response->mutable_vehicle();
          EncodeVehicle(vehicle, answer);
          if (!MayRead(*call, vehicle.id)) {
            *answer = IdentityOf(*answer);
            EncodeSettings(requested, answer->mutable_settings());
          }
          return absl::OkStatus();
        };
        const auto encode_created = [=](const CreatedVehicle& created) {
          return created.view != nullptr ? encode(*created.view)
                                         : encode(created.record);
        };
        const auto compare = [=](const VehicleView& view) {
          if (view.config_is_known && SameSettings(view.config, requested)) {
            return encode(view);
          }
          return Error(
              absl::StatusCode::kAlreadyExists, "VEHICLE_EXISTS",
              absl::StrCat(VehicleName(view.id),
                           " exists with other settings; change them with "
                           "UpdateVehicle, or take another id"));
        };
        CreateOrFind(context_.fleet, call, id, requested,
                     FinishWith<CreatedVehicle>(call, encode_created),
                     FinishWith<VehicleView>(call, compare));
        return absl::OkStatus();
      });
}

grpc::ServerUnaryReactor* PoseGraphService::GetVehicle(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::GetVehicleRequest, v1::GetVehicleResponse>(
      call_context, "GetVehicle", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::GetVehicleRequest* request,
          v1::GetVehicleResponse* response) {
        const auto session = SessionOf(context_, request->name(),
                                       kRequest.Field("name"), call.get());
        if (!session.ok()) return session.status();
        (*session)->Read(FinishWith<VehicleView>(call, [=](const auto& view) {
          EncodeVehicle(view, response->mutable_vehicle());
          return absl::OkStatus();
        }));
        return absl::OkStatus();
      });
}

grpc::ServerUnaryReactor* PoseGraphService::ListVehicles(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::ListVehiclesRequest, v1::ListVehiclesResponse>(
      call_context, "ListVehicles", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::ListVehiclesRequest* request,
          v1::ListVehiclesResponse* response) {
        return server::ListVehicles(context_, call, *request, response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::UpdateVehicle(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::UpdateVehicleRequest, v1::UpdateVehicleResponse>(
      call_context, "UpdateVehicle", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::UpdateVehicleRequest* request,
          v1::UpdateVehicleResponse* response) {
        const FieldPath vehicle = kRequest.Field("vehicle");
        const auto session = SessionOf(context_, request->vehicle().name(),
                                       vehicle.Field("name"), call.get());
        if (!session.ok()) return session.status();
        (*session)->Update(
            [=](const VehicleView& view) -> absl::StatusOr<VehicleConfig> {
              if (call->given_up()) return call->GivenUpStatus();
              absl::StatusOr<VehicleConfig> config =
                  UpdateConfig(view.config, view.durable_sequence > 0,
                               request->vehicle(), request->update_mask());
              if (!config.ok() ||
                  !core::MovesNodes(view.config.drive, config->drive)) {
                return config;
              }
              const absl::Status room =
                  call->room().TakeRebuild(view.durable_sequence);
              if (!room.ok()) return room;
              return config;
            },
            FinishWith<VehicleView>(call, [=](const VehicleView& view) {
              v1::Vehicle* const answer = response->mutable_vehicle();
              EncodeVehicle(view, answer);
              if (MayRead(*call, view.id)) return absl::OkStatus();
              const v1::Vehicle whole = *answer;
              TrimToMask(request->update_mask(), answer);
              // An origin that was left out may be that of the first pose.
              if (!request->vehicle().settings().has_geodetic_origin()) {
                answer->mutable_settings()->clear_geodetic_origin();
              }
              answer->MergeFrom(IdentityOf(whole));
              return absl::OkStatus();
            }));
        return absl::OkStatus();
      });
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteVehicle(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::DeleteVehicleRequest, v1::DeleteVehicleResponse>(
      call_context, "DeleteVehicle", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::DeleteVehicleRequest* request,
          v1::DeleteVehicleResponse*) {
        const absl::StatusOr<std::string> id =
            ParseVehicleName(request->name(), kRequest.Field("name"));
        if (!id.ok()) return id.status();
        if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
          return status;
        }
        context_.fleet->Delete(
            *id, [=](const absl::Status& status) { call->End(status); });
        return absl::OkStatus();
      });
}

grpc::ServerUnaryReactor* PoseGraphService::AppendPoses(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::AppendPosesRequest, v1::AppendPosesResponse>(
      call_context, "AppendPoses", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, v1::AppendPosesRequest* request,
          v1::AppendPosesResponse* response) {
        const auto session = SessionOf(context_, request->vehicle(),
                                       kRequest.Field("vehicle"), call.get());
        absl::Status status = session.status();
        if (status.ok()) {
          status =
              CheckUid(request->vehicle_uid(), kRequest.Field("vehicle_uid"));
        }
        if (status.ok())
          status = call->room().TakeBatch(request->ByteSizeLong());
        if (!status.ok()) {
          context_.counts->Refused(
              static_cast<std::uint64_t>(request->poses_size()), status);
          return status;
        }
        AppendRequest append;
        append.decode = DecoderOf(&request->poses(),
                                  context_.limits.max_batch_poses, nullptr);
        append.vehicle_uid = request->vehicle_uid();
        (*session)->Append(std::move(append),
                           std::make_shared<UnaryAppend>(
                               call, request, response, context_.counts));
        return absl::OkStatus();
      });
}

grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>*
PoseGraphService::StreamPoses(grpc::CallbackServerContext* call_context) {
  return StartPoseStream(call_context, context_);
}

grpc::ServerUnaryReactor* PoseGraphService::FindCandidates(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::FindCandidatesRequest, v1::FindCandidatesResponse>(
      call_context, "FindCandidates", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::FindCandidatesRequest* request,
          v1::FindCandidatesResponse* response) {
        return server::FindCandidates(context_, call, *request, response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::AddLoopClosure(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::AddLoopClosureRequest, v1::AddLoopClosureResponse>(
      call_context, "AddLoopClosure", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::AddLoopClosureRequest* request,
          v1::AddLoopClosureResponse* response) {
        return AddPair(
            context_, call, PairKind::kLoopClosure, request->parent(),
            request->loop_closure_id(),
            request->has_loop_closure() ? &request->loop_closure() : nullptr,
            &v1::AddLoopClosureResponse::mutable_loop_closure, response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::ListLoopClosures(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::ListLoopClosuresRequest, v1::ListLoopClosuresResponse>(
      call_context, "ListLoopClosures", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::ListLoopClosuresRequest* request,
          v1::ListLoopClosuresResponse* response) {
        return ListPairs(context_, call, PairKind::kLoopClosure,
                         "ListLoopClosures", *request,
                         response->mutable_loop_closures(), response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteLoopClosure(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::DeleteLoopClosureRequest, v1::DeleteLoopClosureResponse>(
      call_context, "DeleteLoopClosure", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::DeleteLoopClosureRequest* request,
          v1::DeleteLoopClosureResponse* response) {
        return DeletePair(context_, call, PairKind::kLoopClosure,
                          request->name(), response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::RejectCandidate(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::RejectCandidateRequest, v1::RejectCandidateResponse>(
      call_context, "RejectCandidate", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::RejectCandidateRequest* request,
          v1::RejectCandidateResponse* response) {
        return AddPair(
            context_, call, PairKind::kRejectedCandidate, request->parent(),
            request->rejected_candidate_id(),
            request->has_rejected_candidate() ? &request->rejected_candidate()
                                              : nullptr,
            &v1::RejectCandidateResponse::mutable_rejected_candidate, response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::ListRejectedCandidates(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::ListRejectedCandidatesRequest,
               v1::ListRejectedCandidatesResponse>(
      call_context, "ListRejectedCandidates", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call,
          const v1::ListRejectedCandidatesRequest* request,
          v1::ListRejectedCandidatesResponse* response) {
        return ListPairs(context_, call, PairKind::kRejectedCandidate,
                         "ListRejectedCandidates", *request,
                         response->mutable_rejected_candidates(), response);
      });
}

grpc::ServerUnaryReactor* PoseGraphService::DeleteRejectedCandidate(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::DeleteRejectedCandidateRequest,
               v1::DeleteRejectedCandidateResponse>(
      call_context, "DeleteRejectedCandidate", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call,
          const v1::DeleteRejectedCandidateRequest* request,
          v1::DeleteRejectedCandidateResponse* response) {
        return DeletePair(context_, call, PairKind::kRejectedCandidate,
                          request->name(), response);
      });
}

grpc::ServerReadReactor<grpc::ByteBuffer>* PoseGraphService::RevisePoses(
    grpc::CallbackServerContext* call_context, grpc::ByteBuffer* response) {
  return StartRevision(call_context, context_, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListPoses(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::ListPosesRequest, v1::ListPosesResponse>(
      call_context, "ListPoses", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::ListPosesRequest* request,
          v1::ListPosesResponse* response) {
        return server::ListPoses(context_, call, *request, response);
      });
}

grpc::ServerWriteReactor<grpc::ByteBuffer>* PoseGraphService::ExportPoseGraph(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request) {
  return StartExport(call_context, context_, request);
}

grpc::ServerUnaryReactor* PoseGraphService::AcceptDataLoss(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::AcceptDataLossRequest, v1::AcceptDataLossResponse>(
      call_context, "AcceptDataLoss", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::AcceptDataLossRequest* request,
          v1::AcceptDataLossResponse* response) {
        const auto session = SessionOf(context_, request->name(),
                                       kRequest.Field("name"), call.get());
        if (!session.ok()) return session.status();
        (*session)->AcceptDataLoss(
            request->durable_sequence(),
            FinishWith<VehicleView>(
                call, [=, counts = context_.counts](const VehicleView& view) {
                  counts->Decided(Decision::kDataLossAccepted);
                  v1::Vehicle* const vehicle = response->mutable_vehicle();
                  EncodeVehicle(view, vehicle);
                  if (MayRead(*call, view.id)) return absl::OkStatus();
                  *vehicle = IdentityOf(*vehicle);
                  vehicle->set_state(v1::VEHICLE_STATE_ACTIVE);
                  return absl::OkStatus();
                }));
        return absl::OkStatus();
      });
}

grpc::ServerUnaryReactor* PoseGraphService::GetServerInfo(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::GetServerInfoRequest, v1::GetServerInfoResponse>(
      call_context, "GetServerInfo", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::GetServerInfoRequest*,
          v1::GetServerInfoResponse* response) {
        response->set_version(REVISIT_VERSION);
        EncodeDurability(context_.storage->GetDurability(), response);
        response->set_store_format(kStoreFormat);
        response->set_max_batch_poses(context_.limits.max_batch_poses);
        response->set_max_message_bytes(context_.limits.max_message_bytes);
        response->set_max_batches_in_flight(
            context_.limits.max_batches_in_flight);
        // A tenant does not learn how much others have on the servers.
        if (call->rights().caller().grants &&
            call->rights().caller().tenant != "*") {
          call->End(absl::OkStatus());
          return absl::OkStatus();
        }
        response->set_over_all_tenants(true);
        const Fleet::Residency residency = context_.fleet->residency();
        response->set_resident_vehicle_count(residency.vehicles);
        response->set_resident_node_count(residency.nodes);
        response->set_resident_bytes(residency.bytes);
        // The server tells what it knows itself also where the store is away.
        if (const auto users = context_.storage->ListUsers(); users.ok()) {
          EncodeStorageUsers(*users, response);
        }
        call->End(absl::OkStatus());
        return absl::OkStatus();
      });
}

}  // namespace revisit::server
