#include "server/service/pose_graph_service.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "google/protobuf/util/field_mask_util.h"
#include "server/base/status.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/page_token.h"
#include "server/conversion/proto_conversion.h"
#include "server/service/call.h"
#include "server/service/export_pose_graph.h"
#include "server/service/message_bytes.h"
#include "server/service/revise_poses.h"
#include "server/service/stream_poses.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/sessions/vehicle_uid.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using google::protobuf::util::FieldMaskUtil;

// Clients read messages of 4 MiB unless told otherwise; a page stays well
// below.
constexpr std::size_t kMaxPageBytes = std::size_t{2} << 20;

constexpr FieldPath kRequest;

std::int64_t NowNanoseconds() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

// The reactor of a unary call. Held by a shared_ptr for the reasons given in
// stream_poses.cc.
class UnaryCall : public grpc::ServerUnaryReactor,
                  public std::enable_shared_from_this<UnaryCall> {
 public:
  UnaryCall(grpc::CallbackServerContext* context, const char* method,
            const ServiceContext& service)
      : call_(context, method, service) {}

  // Before anything else.
  void Start() { self_ = shared_from_this(); }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    call_.Done();
    // May destroy this.
    const std::shared_ptr<UnaryCall> self = std::move(self_);
  }

  const absl::Status& admission() const { return call_.admission(); }
  const Caller& caller() const { return call_.caller(); }
  absl::Status ChooseVehicle(const std::string& id) {
    return call_.ChooseVehicle(id);
  }
  absl::Status AdmitSearch() { return call_.AdmitSearch(); }
  void SearchTook(std::chrono::steady_clock::duration duration) const {
    call_.SearchTook(duration);
  }
  absl::Status HoldBatch(std::size_t bytes) { return call_.HoldBatch(bytes); }
  bool given_up() const { return call_.given_up(); }
  absl::Status GivenUpStatus() const { return call_.GivenUpStatus(); }

  // Once, on any thread.
  void End(const absl::Status& status) {
    if (status.ok()) WriteResponse();
    Finish(call_.End(status));
  }

 private:
  virtual void WriteResponse() = 0;

  Call call_;
  std::shared_ptr<UnaryCall> self_;
};

// The same with its messages.
template <typename Request, typename Response>
class TypedCall final : public UnaryCall {
 public:
  // The bytes of the response live until Finish().
  TypedCall(grpc::CallbackServerContext* context, const char* method,
            const ServiceContext& service, grpc::ByteBuffer* response_bytes)
      : UnaryCall(context, method, service), response_bytes_(response_bytes) {}

  Request request;
  Response response;

 private:
  void WriteResponse() override { WriteMessage(response, response_bytes_); }

  grpc::ByteBuffer* const response_bytes_;
};

using UnaryCallPtr = std::shared_ptr<UnaryCall>;

// A callback that finishes the call with what `encode` makes of the value.
template <typename Value, typename Encode>
std::function<void(absl::StatusOr<Value>)> FinishWith(UnaryCallPtr call,
                                                      Encode encode) {
  return [call = std::move(call), encode](absl::StatusOr<Value> value) {
    // Nobody waits for what would be made of it.
    const absl::Status given_up =
        call->given_up() ? call->GivenUpStatus() : absl::OkStatus();
    if (!value.ok() || !given_up.ok()) {
      call->End(value.ok() ? given_up : value.status());
      return;
    }
    const absl::Status status = encode(*value);
    call->End(status);
  };
}

// Opens the session of the vehicle that a field names.
absl::StatusOr<std::shared_ptr<VehicleSession>> SessionOf(
    const ServiceContext& context, const std::string& name,
    const FieldPath& path, UnaryCall* call) {
  absl::StatusOr<std::string> id = ParseVehicleName(name, path);
  if (!id.ok()) return id.status();
  if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
    return status;
  }
  return context.fleet->Session(*id);
}

// A page of vehicles as they are stored, of those that the caller may read. The
// others leave no trace: not in the page's length, nor in its token.
absl::Status ListStored(Storage* storage, const Caller& caller,
                        const std::string& list, const std::string& after,
                        int page_size, v1::ListVehiclesResponse* response) {
  std::string last;
  for (const std::string& prefix : caller.PrefixesOf(Verb::kRead)) {
    std::string place = after;
    for (bool past = false; !past;) {
      // One more tells whether there is another page. Few at a time would be
      // slow where few of many may be read.
      const int wanted =
          std::max(page_size - response->vehicles_size() + 1, 100);
      const auto records = storage->ListVehicles(place, prefix, wanted);
      if (!records.ok()) return records.status();
      past = static_cast<int>(records->size()) < wanted;
      for (const VehicleRecord& record : *records) {
        if (!caller.May(Verb::kRead, record.id)) continue;
        if (response->vehicles_size() == page_size) {
          response->set_next_page_token(MakePageToken(list, last));
          return absl::OkStatus();
        }
        EncodeVehicle(record, response->add_vehicles());
        last = record.id;
      }
      if (!past) place = records->back().id;
    }
  }
  return absl::OkStatus();
}

// Replaces what is stored by what the vehicles in memory say, each in its own
// time, then finishes the call.
void FillFromMemory(Fleet* fleet, const UnaryCallPtr& call,
                    v1::ListVehiclesResponse* response) {
  // The last to let go of it finishes the call.
  const std::shared_ptr<void> finish(
      nullptr, [call](void*) { call->End(absl::OkStatus()); });
  for (v1::Vehicle& vehicle : *response->mutable_vehicles()) {
    const std::string id = vehicle.name().substr(VehicleName("").size());
    const auto session = fleet->SessionIfLoaded(id);
    if (session == nullptr) continue;
    session->Read([finish, session = std::weak_ptr<VehicleSession>(session),
                   &vehicle](const absl::StatusOr<VehicleView>& view) {
      // It may have been deleted or unloaded meanwhile: then what was stored
      // stands.
      if (!view.ok()) return;
      if (vehicle.state() == v1::VEHICLE_STATE_DAMAGED && view->damage.ok()) {
        if (const auto loaded = session.lock()) loaded->LoadAnew();
        return;
      }
      vehicle.Clear();
      EncodeVehicle(*view, &vehicle);
    });
  }
}

// What a caller is told of a vehicle that it changed but may not read: which
// one it is, and the settings that it named itself.
v1::Vehicle ToldToWriter(const v1::Vehicle& vehicle) {
  v1::Vehicle told;
  told.set_name(vehicle.name());
  told.set_uid(vehicle.uid());
  return told;
}

bool MayRead(const UnaryCall& call, const std::string& vehicle_id) {
  return call.caller().May(Verb::kRead, vehicle_id);
}

// Creates a vehicle, or finds the one of that name that is there. One that is
// deleted between the two is made anew: a creation never finds nothing.
void CreateOrFind(
    Fleet* fleet, const UnaryCallPtr& call, const std::string& id,
    const VehicleConfig& config,
    const std::function<void(absl::StatusOr<VehicleView>)>& created,
    const std::function<void(absl::StatusOr<VehicleView>)>& found) {
  fleet->Create(id, config, [=](const absl::StatusOr<VehicleView>& made) {
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
class UnaryAppend final : public AppendSink {
 public:
  UnaryAppend(UnaryCallPtr call, v1::AppendPosesRequest* request,
              v1::AppendPosesResponse* response, int max_poses)
      : call_(std::move(call)),
        request_(request),
        response_(response),
        max_poses_(max_poses) {}

  absl::StatusOr<DecodedBatch> Decode(const VehicleConfig& config) override {
    // It may have waited long.
    if (call_->given_up()) return call_->GivenUpStatus();
    const std::string id = request_->vehicle().substr(VehicleName("").size());
    if (absl::Status meant = CheckMeant(id, config, request_->vehicle_uid());
        !meant.ok()) {
      return meant;
    }
    DropUnknownFields(request_->mutable_poses());
    return DecodeBatch(request_->poses(), max_poses_, config, kRequest);
  }

  void OnDurable(const absl::StatusOr<Acknowledgement>& result) override {
    if (result.ok()) EncodeAck(*result, response_->mutable_ack());
    call_->End(result.status());
  }

 private:
  const UnaryCallPtr call_;
  v1::AppendPosesRequest* const request_;
  v1::AppendPosesResponse* const response_;
  const int max_poses_;
};

// Where a page of poses begins.
absl::StatusOr<std::uint64_t> FirstSequence(const v1::ListPosesRequest& request,
                                            const std::string& list) {
  const absl::StatusOr<std::uint64_t> last =
      ParseSequenceToken(list, request.page_token());
  if (!last.ok()) return last.status();
  if (*last > 0) return *last + 1;
  return request.first_sequence() == 0 ? 1 : request.first_sequence();
}

absl::Status CheckReadMask(const google::protobuf::FieldMask& mask) {
  Violations violations;
  const FieldPath path = kRequest.Field("read_mask");
  for (int i = 0; i < mask.paths_size(); ++i) {
    if (!FieldMaskUtil::IsValidPath<v1::Pose>(mask.paths(i))) {
      violations.Add(
          "INVALID_FIELD", path.At("paths", static_cast<std::size_t>(i)),
          "got " + Quoted(mask.paths(i)) + ", which is no field of Pose");
    }
  }
  return violations.ToStatus();
}

// Fills a page with the poses from `first` on. Where they are damaged, a page
// ends before the damage, and the next one begins with it: DATA_LOSS.
absl::Status ReadPoses(Storage* storage, const VehicleView& view,
                       std::uint64_t first, int page_size,
                       const google::protobuf::FieldMask& mask,
                       const std::string& list,
                       v1::ListPosesResponse* response) {
  if (first > view.durable_sequence) return view.damage;
  const std::uint64_t last = std::min(
      view.durable_sequence, first + static_cast<std::uint64_t>(page_size) - 1);
  std::uint64_t last_taken = 0;
  std::size_t bytes = 0;
  absl::Status parsed;
  const absl::Status read = storage->ReadBatches(
      view.key, first, last, BatchVersion::kCurrent,
      [&](const BatchRecord& batch) {
        parsed = VisitPoses(batch, [&](v1::Pose* pose) {
          if (pose->sequence() < first) return true;
          if (pose->sequence() > last || bytes > kMaxPageBytes) return false;
          last_taken = pose->sequence();
          if (mask.paths_size() > 0) FieldMaskUtil::TrimMessage(mask, pose);
          bytes += pose->ByteSizeLong();
          response->add_poses()->Swap(pose);
          return true;
        });
        return parsed.ok() && bytes <= kMaxPageBytes;
      });
  const absl::Status& failure = read.ok() ? parsed : read;
  if (!failure.ok() && !(absl::IsDataLoss(failure) && last_taken > 0)) {
    return failure;
  }
  if (last_taken < view.durable_sequence || !view.damage.ok()) {
    response->set_next_page_token(MakePageToken(list, last_taken));
  }
  return absl::OkStatus();
}

// The node at which to ask; nothing if the vehicle has none.
absl::StatusOr<std::optional<core::NodeIndex>> QueryNode(
    const VehicleView& view, std::uint64_t sequence) {
  const core::PoseGraph& graph = view.engine.graph();
  if (sequence > view.durable_sequence) {
    return PoseNotFound(view.id, sequence, view.durable_sequence);
  }
  if (sequence > 0) return graph.NodeAtOrBefore(sequence);
  if (graph.size() == 0) return std::optional<core::NodeIndex>();
  return std::optional<core::NodeIndex>(graph.size() - 1);
}

absl::Status TooMuchWork(std::int64_t got, std::int64_t limit) {
  return Error(
      absl::StatusCode::kOutOfRange, "LIMIT_EXCEEDED",
      "the search would compare " + std::to_string(got) +
          " pairs of nodes; allowed are " + std::to_string(limit) +
          ": take a shorter sequence, a longer node spacing or one "
          "direction",
      {{"got", std::to_string(got)}, {"limit", std::to_string(limit)}});
}

absl::Status Find(const UnaryCall& call, const Limits& limits,
                  const VehicleView& view,
                  const v1::FindCandidatesRequest& request,
                  v1::FindCandidatesResponse* response) {
  // It may have waited long behind other work.
  if (call.given_up()) return call.GivenUpStatus();
  // What the history lacks would not be found, and nobody would know.
  if (!view.damage.ok()) return view.damage;
  absl::StatusOr<core::SearchOptions> options = DecodeCandidateOptions(
      request.options(), view.config, kRequest.Field("options"));
  if (!options.ok()) return options.status();
  options->max_comparisons = limits.max_search_steps;
  const auto query = QueryNode(view, request.sequence());
  if (!query.ok()) return query.status();
  const auto stop = [&call] { return call.given_up(); };
  const auto start = std::chrono::steady_clock::now();
  const absl::StatusOr<core::CandidateSet> found =
      *query ? view.engine.FindCandidates(**query, *options, stop)
             : view.engine.FindCandidates(*options, stop);
  const auto duration = std::chrono::steady_clock::now() - start;
  call.SearchTook(duration);
  if (absl::IsCancelled(found.status())) return call.GivenUpStatus();
  if (!found.ok()) return found.status();
  if (found->empty_reason == core::EmptyReason::kTooMuchWork) {
    return TooMuchWork(found->comparisons, limits.max_search_steps);
  }
  EncodeCandidateSet(view, *found, request.options().include_aligned_path(),
                     duration, response->mutable_candidates());
  return absl::OkStatus();
}

// Adds a pair of poses to the vehicle that `parent` names. `pair` is null if it
// was left out; `added` is where the stored one goes, in `response`.
template <typename Pair, typename Response>
absl::Status AddPair(const ServiceContext& context, const UnaryCallPtr& call,
                     PairKind kind, const std::string& parent,
                     const std::string& id, const Pair* pair,
                     Pair* (Response::*added)(), Response* response) {
  const absl::StatusOr<std::string> vehicle =
      ParseVehicleName(parent, kRequest.Field("parent"));
  if (!vehicle.ok()) return vehicle.status();
  if (absl::Status status = call->ChooseVehicle(*vehicle); !status.ok()) {
    return status;
  }
  absl::StatusOr<PosePairRecord> record = DecodePosePair(pair, id);
  if (!record.ok()) return record.status();
  record->create_time_ns = NowNanoseconds();
  using Stored = std::pair<PosePairRecord, std::uint64_t>;
  context.fleet->Session(*vehicle)->AddPosePair(
      kind, *std::move(record),
      FinishWith<Stored>(
          call, [=, id_of_vehicle = *vehicle](const auto& stored) {
            EncodePosePair(id_of_vehicle, stored.first, (response->*added)());
            response->set_revision(stored.second);
            return absl::OkStatus();
          }));
  return absl::OkStatus();
}

// Lists the pairs of the vehicle that the request's parent names; they go to
// `page`, in `response`.
template <typename Pair, typename Request, typename Response>
absl::Status ListPairs(const ServiceContext& context, const UnaryCallPtr& call,
                       PairKind kind, const std::string& method,
                       const Request& request,
                       google::protobuf::RepeatedPtrField<Pair>* page,
                       Response* response) {
  const auto session = SessionOf(context, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const std::string list = method + " " + request.parent();
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 100, 1000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<std::string> after =
      ParsePageToken(list, request.page_token());
  if (!after.ok()) return after.status();
  (*session)->Read(FinishWith<VehicleView>(call, [=](const VehicleView& view) {
    const PosePairs& pairs = view.pairs(kind);
    auto next = pairs.upper_bound(*after);
    std::string last;
    for (; next != pairs.end() && page->size() < *page_size; ++next) {
      EncodePosePair(view.id, next->second, page->Add());
      last = next->first;
    }
    if (next == pairs.end() && view.damage.ok()) return absl::OkStatus();
    // Behind those that are sound comes what is wrong with the others.
    if (last.empty()) return view.damage;
    response->set_next_page_token(MakePageToken(list, last));
    return absl::OkStatus();
  }));
  return absl::OkStatus();
}

template <typename Response>
absl::Status DeletePair(const ServiceContext& context, const UnaryCallPtr& call,
                        PairKind kind, const std::string& name,
                        Response* response) {
  const absl::StatusOr<PosePairName> parsed =
      ParsePosePairName(kind, name, kRequest.Field("name"));
  if (!parsed.ok()) return parsed.status();
  if (absl::Status status = call->ChooseVehicle(parsed->vehicle_id);
      !status.ok()) {
    return status;
  }
  context.fleet->Session(parsed->vehicle_id)
      ->DeletePosePair(
          kind, parsed->id,
          FinishWith<std::uint64_t>(call, [=](std::uint64_t revision) {
            response->set_revision(revision);
            return absl::OkStatus();
          }));
  return absl::OkStatus();
}

}  // namespace

template <typename Request, typename Response, typename Handle>
grpc::ServerUnaryReactor* PoseGraphService::Unary(
    grpc::CallbackServerContext* context, const char* method,
    const grpc::ByteBuffer* request, grpc::ByteBuffer* response,
    Handle handle) {
  const auto call = std::make_shared<TypedCall<Request, Response>>(
      context, method, context_, response);
  call->Start();
  absl::Status status = call->admission();
  if (status.ok()) status = ParseMessage(request, &call->request);
  if (status.ok()) status = handle(call, &call->request, &call->response);
  if (!status.ok()) call->End(status);
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
        absl::StatusOr<VehicleConfig> config =
            DecodeSettings(request->vehicle().settings(),
                           kRequest.Field("vehicle").Field("settings"));
        if (!config.ok()) return config.status();
        config->create_time_ns = NowNanoseconds();
        config->uid = NewVehicleUid();
        const VehicleConfig requested = *config;
        const auto encode = [=](const VehicleView& view) {
          v1::Vehicle* const vehicle = response->mutable_vehicle();
          EncodeVehicle(view, vehicle);
          if (!MayRead(*call, view.id)) {
            *vehicle = ToldToWriter(*vehicle);
            EncodeSettings(requested, vehicle->mutable_settings());
          }
          return absl::OkStatus();
        };
        const auto compare = [=](const VehicleView& view) {
          if (view.config_is_known && SameSettings(view.config, requested)) {
            return encode(view);
          }
          return Error(absl::StatusCode::kAlreadyExists, "VEHICLE_EXISTS",
                       VehicleName(view.id) +
                           " exists with other settings; change them with "
                           "UpdateVehicle, or take another id");
        };
        CreateOrFind(context_.fleet, call, id, requested,
                     FinishWith<VehicleView>(call, encode),
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
        const std::string list = "ListVehicles";
        const absl::StatusOr<int> page_size =
            PageSize(request->page_size(), 100, 1000);
        if (!page_size.ok()) return page_size.status();
        const absl::StatusOr<std::string> after =
            ParsePageToken(list, request->page_token());
        if (!after.ok()) return after.status();
        context_.executor->Post([=, context = context_] {
          const absl::Status status =
              ListStored(context.storage, call->caller(), list, *after,
                         *page_size, response);
          if (status.ok()) {
            FillFromMemory(context.fleet, call, response);
          } else {
            call->End(status);
          }
        });
        return absl::OkStatus();
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
              return UpdateSettings(view.config, view.durable_sequence > 0,
                                    request->vehicle().settings(),
                                    request->update_mask());
            },
            FinishWith<VehicleView>(call, [=](const VehicleView& view) {
              v1::Vehicle* const answer = response->mutable_vehicle();
              EncodeVehicle(view, answer);
              if (MayRead(*call, view.id)) return absl::OkStatus();
              const v1::Vehicle whole = *answer;
              FieldMaskUtil::TrimMessage(request->update_mask(), answer);
              // Left out, it may be that of the first pose.
              if (!request->vehicle().settings().has_geodetic_origin()) {
                answer->mutable_settings()->clear_geodetic_origin();
              }
              answer->MergeFrom(ToldToWriter(whole));
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
        if (!session.ok()) return session.status();
        if (absl::Status status =
                CheckUid(request->vehicle_uid(), kRequest.Field("vehicle_uid"));
            !status.ok()) {
          return status;
        }
        if (absl::Status status = call->HoldBatch(request->ByteSizeLong());
            !status.ok()) {
          return status;
        }
        (*session)->Append(std::make_shared<UnaryAppend>(
            call, request, response, context_.limits.max_batch_poses));
        return absl::OkStatus();
      });
}

grpc::ServerBidiReactor<v1::StreamPosesRequest, v1::StreamPosesResponse>*
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
        const auto session = SessionOf(context_, request->vehicle(),
                                       kRequest.Field("vehicle"), call.get());
        if (!session.ok()) return session.status();
        if (absl::Status status = call->AdmitSearch(); !status.ok())
          return status;
        (*session)->Search(FinishWith<VehicleView>(
            call, [=, limits = context_.limits](const VehicleView& view) {
              return Find(*call, limits, view, *request, response);
            }));
        return absl::OkStatus();
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

grpc::ServerReadReactor<v1::RevisePosesRequest>* PoseGraphService::RevisePoses(
    grpc::CallbackServerContext* call_context,
    v1::RevisePosesResponse* response) {
  return StartRevision(call_context, context_, response);
}

grpc::ServerUnaryReactor* PoseGraphService::ListPoses(
    grpc::CallbackServerContext* call_context,
    const grpc::ByteBuffer* request_bytes, grpc::ByteBuffer* response_bytes) {
  return Unary<v1::ListPosesRequest, v1::ListPosesResponse>(
      call_context, "ListPoses", request_bytes, response_bytes,
      [=](const UnaryCallPtr& call, const v1::ListPosesRequest* request,
          v1::ListPosesResponse* response) {
        const auto session = SessionOf(context_, request->parent(),
                                       kRequest.Field("parent"), call.get());
        if (!session.ok()) return session.status();
        const std::string list = "ListPoses " + request->parent();
        const absl::StatusOr<int> page_size =
            PageSize(request->page_size(), 1000, 10000);
        if (!page_size.ok()) return page_size.status();
        const absl::StatusOr<std::uint64_t> first =
            FirstSequence(*request, list);
        if (!first.ok()) return first.status();
        if (absl::Status status = CheckReadMask(request->read_mask());
            !status.ok()) {
          return status;
        }
        const std::weak_ptr<VehicleSession> loaded = *session;
        (*session)->ReadStored(FinishWith<VehicleView>(
            call, [=, storage = context_.storage](const VehicleView& view) {
              const absl::Status status =
                  ReadPoses(storage, view, *first, *page_size,
                            request->read_mask(), list, response);
              const auto still_there = loaded.lock();
              if (absl::IsDataLoss(status) && still_there != nullptr) {
                still_there->LoadAnew();
              }
              return status;
            }));
        return absl::OkStatus();
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
            FinishWith<VehicleView>(call, [=](const VehicleView& view) {
              v1::Vehicle* const vehicle = response->mutable_vehicle();
              EncodeVehicle(view, vehicle);
              if (MayRead(*call, view.id)) return absl::OkStatus();
              *vehicle = ToldToWriter(*vehicle);
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
        response->set_durability(v1::DURABILITY_LOCAL);
        response->set_store_format(kStoreFormat);
        response->set_max_batch_poses(context_.limits.max_batch_poses);
        response->set_max_message_bytes(context_.limits.max_message_bytes);
        response->set_max_batches_in_flight(
            context_.limits.max_batches_in_flight);
        // What others have on the server is no business of a tenant's.
        if (!call->caller().grants || call->caller().tenant == "*") {
          const Fleet::Residency residency = context_.fleet->residency();
          response->set_resident_vehicle_count(residency.vehicles);
          response->set_resident_node_count(residency.nodes);
          response->set_resident_bytes(residency.bytes);
        }
        call->End(absl::OkStatus());
        return absl::OkStatus();
      });
}

}  // namespace revisit::server
