#include "server/service/group_link_calls.h"

#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/conversion/groups.h"
#include "server/groups/group_edits.h"
#include "server/groups/group_reads.h"
#include "server/groups/link_kind.h"
#include "server/records/proto_record_codec.h"
#include "server/service/group_page.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// Adds a link to the group that the request's parent names; `added` is the
// field of the response for it.
template <typename Request, typename Response, typename Message>
absl::Status Add(const ServiceContext& service, const UnaryCallPtr& call,
                 const Request& request, Message* (Response::*added)(),
                 Response* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  absl::StatusOr<NewLink> decoded =
      DecodeLink(request, call->rights().caller().identity);
  if (!decoded.ok()) return decoded.status();
  call->record().NameChanged(decoded->id);
  for (const NewLink::Pose& pose : {decoded->query, decoded->matched}) {
    const absl::Status status =
        call->rights().AlsoNeeds(Verb::kRead, pose.vehicle_id);
    if (!status.ok()) return status;
  }
  const auto wanted = std::make_shared<const NewLink>(*std::move(decoded));
  const auto link = std::make_shared<GroupLinkRecord>();
  const auto is_new = std::make_shared<bool>(false);
  service.groups->Change(
      {*group, 0, [call] { return CheckAwaited(*call); }},
      [=, storage = service.storage](const GroupRecord& record) {
        absl::StatusOr<GroupEdit> edit =
            EditToAddLink(storage, ProtoRecordCodec(), record, *wanted,
                          NowNanoseconds(), GroupLimits(), link.get());
        *is_new = edit.ok() && !edit->changes.empty();
        return edit;
      },
      FinishWith<GroupVersion>(
          call, [=, group_id = *group,
                 counts = service.counts](const GroupVersion& version) {
            if (*is_new) {
              counts->Decided(wanted->kind == PairKind::kLoopClosure
                                  ? Decision::kLoopClosureAdded
                                  : Decision::kCandidateRejected);
            }
            response->set_revision(version.revision);
            return EncodeLink(group_id, wanted->query.vehicle_id,
                              wanted->matched.vehicle_id, *link,
                              (response->*added)());
          }));
  return absl::OkStatus();
}

// Returns the members of a group that the caller may read.
absl::StatusOr<std::map<VehicleKey, std::string>> ReadableMembers(
    GroupStorage* groups, const std::string& group_id, const UnaryCall& call) {
  std::map<VehicleKey, std::string> vehicles;
  const absl::Status status =
      VisitMembers(groups, group_id, [&](GroupMemberRecord& member) {
        if (MayRead(call, member.vehicle_id)) {
          vehicles.emplace(member.vehicle, std::move(member.vehicle_id));
        }
        return true;
      });
  if (!status.ok()) return status;
  return vehicles;
}

// Fills a page, `page` of the response, with the links of one kind.
template <typename Message, typename Response>
absl::Status FillWithLinks(GroupStorage* groups, PairKind kind,
                           const std::string& group_id, const UnaryCall& call,
                           const AskedPage& asked,
                           google::protobuf::RepeatedPtrField<Message>* page,
                           Response* response) {
  const auto vehicles = ReadableMembers(groups, group_id, call);
  if (!vehicles.ok()) return vehicles.status();
  const auto visit = [&](const std::function<bool(GroupLinkRecord&)>& visitor) {
    return VisitLinks(groups, group_id, [&](GroupLinkRecord& link) {
      return KindOf(link) != kind || visitor(link);
    });
  };
  const auto add =
      [&](const GroupLinkRecord& record) -> absl::StatusOr<std::size_t> {
    if (!record.damage.ok()) return record.damage;
    const auto query = vehicles->find(record.query.vehicle);
    const auto matched = vehicles->find(record.matched.vehicle);
    if (query == vehicles->end() || matched == vehicles->end()) {
      return std::size_t{0};
    }
    Message message;
    const absl::Status encoded =
        EncodeLink(group_id, query->second, matched->second, record, &message);
    if (!encoded.ok()) return encoded;
    const std::size_t bytes = message.ByteSizeLong();
    *page->Add() = std::move(message);
    return bytes;
  };
  return FillGroupPage<GroupLinkRecord>(visit, LinkIdOf, add, asked, response);
}

template <typename Request, typename Message, typename Response>
absl::Status List(const ServiceContext& service, const UnaryCallPtr& call,
                  PairKind kind, const std::string& method,
                  const Request& request,
                  google::protobuf::RepeatedPtrField<Message>* page,
                  Response* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  const absl::StatusOr<AskedPage> asked =
      PageOf(absl::StrCat(method, " ", request.parent()), request);
  if (!asked.ok()) return asked.status();
  service.executor->Post([=, storage = service.storage, group_id = *group] {
    call->End(FillWithLinks(&storage->Groups(), kind, group_id, *call, *asked,
                            page, response));
  });
  return absl::OkStatus();
}

template <typename Response>
absl::Status Delete(const ServiceContext& service, const UnaryCallPtr& call,
                    PairKind kind, const std::string& name,
                    Response* response) {
  const absl::StatusOr<NameInGroup> parsed =
      ParseGroupLinkName(kind, name, kRequest.Field("name"));
  if (absl::Status status = ChooseInGroup(parsed, call.get()); !status.ok()) {
    return status;
  }
  call->record().NameChanged(parsed->id);
  auto finish = FinishWith<GroupVersion>(
      call, [=, counts = service.counts](const GroupVersion& version) {
        counts->Decided(kind == PairKind::kLoopClosure
                            ? Decision::kLoopClosureDeleted
                            : Decision::kRejectionDeleted);
        response->set_revision(version.revision);
        return absl::OkStatus();
      });
  service.groups->Change(
      {parsed->group_id, 0, [call] { return CheckAwaited(*call); }},
      [kind, id = parsed->id](const GroupRecord&) {
        return EditToRemoveLink(kind, id);
      },
      [kind, id = parsed->id,
       finish](const absl::StatusOr<GroupVersion>& version) {
        if (version.ok()) {
          finish(version);
        } else {
          finish(RemovalError(kind, id, version.status()));
        }
      });
  return absl::OkStatus();
}

}  // namespace

absl::Status AddInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::AddInterVehicleLoopClosureRequest& request,
    v1::AddInterVehicleLoopClosureResponse* response) {
  return Add(service, call, request,
             &v1::AddInterVehicleLoopClosureResponse::mutable_loop_closure,
             response);
}

absl::Status ListInterVehicleLoopClosures(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListInterVehicleLoopClosuresRequest& request,
    v1::ListInterVehicleLoopClosuresResponse* response) {
  return List(service, call, PairKind::kLoopClosure,
              "ListInterVehicleLoopClosures", request,
              response->mutable_loop_closures(), response);
}

absl::Status DeleteInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteInterVehicleLoopClosureRequest& request,
    v1::DeleteInterVehicleLoopClosureResponse* response) {
  return Delete(service, call, PairKind::kLoopClosure, request.name(),
                response);
}

absl::Status RejectInterVehicleCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::RejectInterVehicleCandidateRequest& request,
    v1::RejectInterVehicleCandidateResponse* response) {
  return Add(
      service, call, request,
      &v1::RejectInterVehicleCandidateResponse::mutable_rejected_candidate,
      response);
}

absl::Status ListInterVehicleRejectedCandidates(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListInterVehicleRejectedCandidatesRequest& request,
    v1::ListInterVehicleRejectedCandidatesResponse* response) {
  return List(service, call, PairKind::kRejectedCandidate,
              "ListInterVehicleRejectedCandidates", request,
              response->mutable_rejected_candidates(), response);
}

absl::Status DeleteInterVehicleRejectedCandidate(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteInterVehicleRejectedCandidateRequest& request,
    v1::DeleteInterVehicleRejectedCandidateResponse* response) {
  return Delete(service, call, PairKind::kRejectedCandidate, request.name(),
                response);
}

}  // namespace revisit::server
