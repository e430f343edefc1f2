#include "server/service/pose_pair_calls.h"

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/drive/agreement.h"
#include "google/protobuf/repeated_field.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/conversion/pose_pairs.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/storage.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// How well a measurement agrees with the graph; only loop closures have one.
void EncodeAgreement(const std::optional<core::Agreement>& agreement,
                     v1::AddLoopClosureResponse* response) {
  if (!agreement) return;
  v1::MeasurementAgreement* const message = response->mutable_agreement();
  message->set_squared_mahalanobis_distance(agreement->squared_mahalanobis);
  message->set_degrees_of_freedom(agreement->degrees_of_freedom);
  message->set_p_value(agreement->p_value);
  message->set_inflation(agreement->inflation);
}
void EncodeAgreement(const std::optional<core::Agreement>&,
                     v1::RejectCandidateResponse*) {}

// Adds a pair of poses to the vehicle that `parent` names. `pair` is null if it
// was left out; `added` is the field of the response for the stored pair.
template <typename Pair, typename Response>
absl::Status AddPair(const ServiceContext& service, const UnaryCallPtr& call,
                     PairKind kind, const std::string& parent,
                     const std::string& id, const Pair* pair,
                     const std::string& candidate, Pair* (Response::*added)(),
                     Response* response) {
  const absl::StatusOr<std::string> vehicle =
      ParseVehicleName(parent, kRequest.Field("parent"));
  if (!vehicle.ok()) return vehicle.status();
  if (absl::Status status = call->ChooseVehicle(*vehicle); !status.ok()) {
    return status;
  }
  absl::StatusOr<PosePairRecord> record =
      DecodePosePair(pair, id, call->rights().caller().identity);
  if (!record.ok()) return record.status();
  record->create_time_ns = NowNanoseconds();
  PairAnswer answers;
  answers.actor = call->rights().caller().identity;
  if (!candidate.empty()) {
    const absl::StatusOr<ParsedCheckName> named =
        ParseCheckCandidateName(candidate, kRequest.Field("candidate"));
    if (!named.ok()) return named.status();
    if (named->vehicle_id != *vehicle) {
      return InvalidField(
          "INVALID_FIELD", kRequest.Field("candidate"),
          absl::StrCat("got one of vehicle '", named->vehicle_id,
                       "'; allowed are those of the parent, '", *vehicle, "'"));
    }
    answers.candidate = CandidateId{named->sequence, named->number};
  }
  call->record().NameChanged(record->id);
  service.fleet->Session(*vehicle)->AddPosePair(
      kind, *std::move(record), std::move(answers),
      FinishWith<AddedPair>(
          call, [=, id_of_vehicle = *vehicle,
                 counts = service.counts](const AddedPair& stored) {
            if (stored.is_new) {
              counts->Decided(kind == PairKind::kLoopClosure
                                  ? Decision::kLoopClosureAdded
                                  : Decision::kCandidateRejected);
            }
            call->record().NameChanged(stored.pair.id);
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
absl::Status ListPairs(const ServiceContext& service, const UnaryCallPtr& call,
                       PairKind kind, const std::string& method,
                       const Request& request,
                       google::protobuf::RepeatedPtrField<Pair>* page,
                       Response* response) {
  const auto session = SessionOf(service, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const absl::StatusOr<AskedPage> asked =
      PageOf(absl::StrCat(method, " ", request.parent()), request);
  if (!asked.ok()) return asked.status();
  (*session)->Read(FinishWith<VehicleView>(call, [=](const VehicleView& view) {
    const PosePairs& pairs = view.pairs(kind);
    auto next = pairs.upper_bound(asked->after);
    std::string last;
    for (; next != pairs.end() && page->size() < asked->size; ++next) {
      EncodePosePair(view.id, next->second, page->Add());
      last = next->first;
    }
    if (next == pairs.end() && view.damage.ok()) return absl::OkStatus();
    // A page of its own, behind all sound pairs, says what is wrong with the
    // others.
    if (last.empty()) return view.damage;
    response->set_next_page_token(MakePageToken(asked->list, last));
    return absl::OkStatus();
  }));
  return absl::OkStatus();
}

// Deletes the pair that `name` names.
template <typename Response>
absl::Status DeletePair(const ServiceContext& service, const UnaryCallPtr& call,
                        PairKind kind, const std::string& name,
                        Response* response) {
  const absl::StatusOr<PosePairName> parsed =
      ParsePosePairName(kind, name, kRequest.Field("name"));
  if (!parsed.ok()) return parsed.status();
  if (absl::Status status = call->ChooseVehicle(parsed->vehicle_id);
      !status.ok()) {
    return status;
  }
  call->record().NameChanged(parsed->id);
  service.fleet->Session(parsed->vehicle_id)
      ->DeletePosePair(
          kind, parsed->id,
          {NowNanoseconds(), call->rights().caller().identity},
          FinishWith<std::uint64_t>(
              call, [=, counts = service.counts](std::uint64_t revision) {
                counts->Decided(kind == PairKind::kLoopClosure
                                    ? Decision::kLoopClosureDeleted
                                    : Decision::kRejectionDeleted);
                response->set_revision(revision);
                return absl::OkStatus();
              }));
  return absl::OkStatus();
}

// Fills a page with deleted pairs, of which `all` are there, whose numbers are
// below `before`; 0 means all. As in ListPairs(), a page of its own says what
// is wrong with others.
absl::Status FillPage(const std::string& vehicle_id,
                      const std::vector<DeletedPairRecord>& all,
                      absl::Status damage, std::uint64_t before, int page_size,
                      const std::string& list,
                      v1::ListDeletedPosePairsResponse* response) {
  std::uint64_t last = 0;
  for (const DeletedPairRecord& deleted : all) {
    damage.Update(deleted.pair.damage);
    const bool is_past = before > 0 && deleted.number >= before;
    if (is_past || !deleted.pair.damage.ok()) continue;
    if (response->deleted_pose_pairs_size() == page_size) {
      response->set_next_page_token(MakePageToken(list, last));
      return absl::OkStatus();
    }
    EncodeDeletedPair(vehicle_id, deleted, response->add_deleted_pose_pairs());
    last = deleted.number;
  }
  if (damage.ok()) return absl::OkStatus();
  if (last == 0) return damage;
  response->set_next_page_token(MakePageToken(list, last));
  return absl::OkStatus();
}

}  // namespace

absl::Status AddLoopClosure(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::AddLoopClosureRequest& request,
                            v1::AddLoopClosureResponse* response) {
  return AddPair(service, call, PairKind::kLoopClosure, request.parent(),
                 request.loop_closure_id(),
                 request.has_loop_closure() ? &request.loop_closure() : nullptr,
                 request.candidate(),
                 &v1::AddLoopClosureResponse::mutable_loop_closure, response);
}

absl::Status ListLoopClosures(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::ListLoopClosuresRequest& request,
                              v1::ListLoopClosuresResponse* response) {
  return ListPairs(service, call, PairKind::kLoopClosure, "ListLoopClosures",
                   request, response->mutable_loop_closures(), response);
}

absl::Status DeleteLoopClosure(const ServiceContext& service,
                               const UnaryCallPtr& call,
                               const v1::DeleteLoopClosureRequest& request,
                               v1::DeleteLoopClosureResponse* response) {
  return DeletePair(service, call, PairKind::kLoopClosure, request.name(),
                    response);
}

absl::Status RejectCandidate(const ServiceContext& service,
                             const UnaryCallPtr& call,
                             const v1::RejectCandidateRequest& request,
                             v1::RejectCandidateResponse* response) {
  return AddPair(
      service, call, PairKind::kRejectedCandidate, request.parent(),
      request.rejected_candidate_id(),
      request.has_rejected_candidate() ? &request.rejected_candidate()
                                       : nullptr,
      request.candidate(),
      &v1::RejectCandidateResponse::mutable_rejected_candidate, response);
}

absl::Status ListRejectedCandidates(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListRejectedCandidatesRequest& request,
    v1::ListRejectedCandidatesResponse* response) {
  return ListPairs(service, call, PairKind::kRejectedCandidate,
                   "ListRejectedCandidates", request,
                   response->mutable_rejected_candidates(), response);
}

absl::Status DeleteRejectedCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteRejectedCandidateRequest& request,
    v1::DeleteRejectedCandidateResponse* response) {
  return DeletePair(service, call, PairKind::kRejectedCandidate, request.name(),
                    response);
}

absl::Status ListDeletedPosePairs(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListDeletedPosePairsRequest& request,
    v1::ListDeletedPosePairsResponse* response) {
  const auto session = SessionOf(service, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const std::string list =
      absl::StrCat("ListDeletedPosePairs ", request.parent());
  const absl::StatusOr<int> page_size = PageSize(request.page_size(), 100, 500);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<std::uint64_t> before =
      ParseSequenceToken(list, request.page_token());
  if (!before.ok()) return before.status();
  const std::weak_ptr<VehicleSession> loaded = *session;
  (*session)->ReadStored(FinishWith<VehicleView>(
      call, [=, storage = service.storage](const VehicleView& view) {
        const auto all = storage->ListDeletedPairs(view.key);
        absl::Status status = all.status();
        if (all.ok()) {
          status = FillPage(view.id, *all, view.damage, *before, *page_size,
                            list, response);
        }
        const auto still_there = loaded.lock();
        if (absl::IsDataLoss(status) && still_there != nullptr) {
          still_there->LoadAnew();
        }
        return status;
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
