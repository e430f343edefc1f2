// The handlers of calls about pairs of poses: the same for loop closures and
// rejected candidates. Each finishes the call, unless it returns an error.
#ifndef REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_
#define REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/drive/agreement.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/conversion/pose_pairs.h"
#include "server/service/unary_call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/storage.h"

namespace revisit::server {

// How well a measurement agrees with the graph; only loop closures have one.
inline void EncodeAgreement(const std::optional<core::Agreement>& agreement,
                            v1::AddLoopClosureResponse* response) {
  if (!agreement) return;
  v1::MeasurementAgreement* const message = response->mutable_agreement();
  message->set_squared_mahalanobis_distance(agreement->squared_mahalanobis);
  message->set_degrees_of_freedom(agreement->degrees_of_freedom);
  message->set_p_value(agreement->p_value);
  message->set_inflation(agreement->inflation);
}
inline void EncodeAgreement(const std::optional<core::Agreement>&,
                            v1::RejectCandidateResponse*) {}

// Adds a pair of poses to the vehicle that `parent` names. `pair` is null if it
// was left out; `added` is the field of the response for the stored pair.
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
  call->NameChanged(record->id);
  context.fleet->Session(*vehicle)->AddPosePair(
      kind, *std::move(record),
      FinishWith<AddedPair>(
          call, [=, id_of_vehicle = *vehicle,
                 counts = context.counts](const AddedPair& stored) {
            if (stored.is_new) {
              counts->Decided(kind == PairKind::kLoopClosure
                                  ? Decision::kLoopClosureAdded
                                  : Decision::kCandidateRejected);
            }
            call->NameChanged(stored.pair.id);
            EncodePosePair(id_of_vehicle, stored.pair, (response->*added)());
            response->set_revision(stored.revision);
            EncodeAgreement(stored.agreement, response);
            return absl::OkStatus();
          }));
  return absl::OkStatus();
}

// Lists the pairs of the vehicle that the request's parent names; `page` is the
// field of the response for them.
template <typename Pair, typename Request, typename Response>
absl::Status ListPairs(const ServiceContext& context, const UnaryCallPtr& call,
                       PairKind kind, const std::string& method,
                       const Request& request,
                       google::protobuf::RepeatedPtrField<Pair>* page,
                       Response* response) {
  const auto session = SessionOf(context, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const std::string list = absl::StrCat(method, " ", request.parent());
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
    // A page of its own, behind all sound pairs, says what is wrong with the
    // others.
    if (last.empty()) return view.damage;
    response->set_next_page_token(MakePageToken(list, last));
    return absl::OkStatus();
  }));
  return absl::OkStatus();
}

// Deletes the pair that `name` names.
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
  call->NameChanged(parsed->id);
  context.fleet->Session(parsed->vehicle_id)
      ->DeletePosePair(
          kind, parsed->id,
          FinishWith<std::uint64_t>(
              call, [=, counts = context.counts](std::uint64_t revision) {
                counts->Decided(kind == PairKind::kLoopClosure
                                    ? Decision::kLoopClosureDeleted
                                    : Decision::kRejectionDeleted);
                response->set_revision(revision);
                return absl::OkStatus();
              }));
  return absl::OkStatus();
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_POSE_PAIR_CALLS_H_
