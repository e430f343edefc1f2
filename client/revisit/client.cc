#include "client/revisit/client.h"

#include <algorithm>
#include <thread>
#include <utility>

#include "client/revisit/owner_route.h"
#include "client/revisit/pose_columns.h"
#include "client/revisit/status.h"
#include "client/revisit/status_from_grpc.h"
#include "grpcpp/client_context.h"
#include "grpcpp/support/sync_stream.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"

namespace revisit::client {
namespace {

using SystemClock = std::chrono::system_clock;
using Stub = v1::PoseGraphService::StubInterface;

enum class Retry { kSafe, kNever };

// Which revision a change of a group is for. One for any may be made again
// where it lost to changes of others.
enum class Revision { kAny, kExpected };

Revision RevisionOf(std::uint64_t expected_revision) {
  return expected_revision == 0 ? Revision::kAny : Revision::kExpected;
}

}  // namespace

struct Client::Rep {
  Rep(const std::shared_ptr<grpc::ChannelInterface>& channel,
      const ClientOptions& client_options)
      : stub(v1::PoseGraphService::NewStub(channel)), options(client_options) {}

  // Runs `attempt(context)`, which answers whether it may be repeated, until it
  // succeeds or must not be repeated.
  template <typename Attempt>
  absl::Status Run(Retry retry, std::chrono::milliseconds limit,
                   const Attempt& attempt,
                   Revision revision = Revision::kExpected) {
    const auto deadline = SystemClock::now() + limit;
    const int attempts = std::max(options.max_attempts, 1);
    Backoff backoff(options.backoff, BackoffSeed());
    absl::Status status;
    for (int count = 1;; ++count) {
      bool repeatable = true;
      status = [&] {
        grpc::ClientContext context;
        context.set_deadline(deadline);
        RouteToOwner(status, &context);
        return attempt(&context, &repeatable);
      }();
      if (WasElsewhere(status) || ReadsHistories(status)) {
        // Until the deadline: after a server has died, others say so until its
        // lease has run out, and the histories of a group may be long.
        --count;
        backoff.Reset();
      } else if (revision == Revision::kAny && LostToOthers(status)) {
        // Nothing was changed.
      } else if (retry == Retry::kNever ||
                 !(absl::IsUnavailable(status) || IsCut(status))) {
        return status;
      }
      if (!repeatable || count >= attempts) return status;
      const auto wait = backoff.Next(DetailsOf(status).retry_delay);
      if (SystemClock::now() + wait >= deadline) return status;
      std::this_thread::sleep_for(wait);
    }
  }

  template <typename Request, typename Response>
  absl::StatusOr<Response> Unary(
      Retry retry,
      grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&,
                                   Response*),
      const Request& request, Revision revision = Revision::kExpected) {
    Response response;
    const absl::Status status = Run(
        retry, options.deadline,
        [&](grpc::ClientContext* context, bool*) {
          return FromGrpc((stub.get()->*method)(context, request, &response));
        },
        revision);
    if (!status.ok()) return status;
    return response;
  }

  const std::unique_ptr<Stub> stub;
  const ClientOptions options;
};

Client::Client(const std::shared_ptr<grpc::ChannelInterface>& channel,
               const ClientOptions& options)
    : rep_(std::make_unique<Rep>(channel, options)) {}

Client::~Client() = default;

absl::StatusOr<v1::CreateVehicleResponse> Client::CreateVehicle(
    const v1::CreateVehicleRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::CreateVehicle, request);
}

absl::StatusOr<v1::GetVehicleResponse> Client::GetVehicle(
    const v1::GetVehicleRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::GetVehicle, request);
}

absl::StatusOr<v1::ListVehiclesResponse> Client::ListVehicles(
    const v1::ListVehiclesRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListVehicles, request);
}

absl::StatusOr<v1::UpdateVehicleResponse> Client::UpdateVehicle(
    const v1::UpdateVehicleRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::UpdateVehicle, request);
}

absl::StatusOr<v1::DeleteVehicleResponse> Client::DeleteVehicle(
    const v1::DeleteVehicleRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteVehicle, request);
}

absl::StatusOr<v1::AppendPosesResponse> Client::AppendPoses(
    const v1::AppendPosesRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::AppendPoses, request);
}

absl::StatusOr<v1::FindCandidatesResponse> Client::FindCandidates(
    const v1::FindCandidatesRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::FindCandidates, request);
}

absl::StatusOr<v1::GetCheckResponse> Client::GetCheck(
    const v1::GetCheckRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::GetCheck, request);
}

absl::StatusOr<v1::ListChecksResponse> Client::ListChecks(
    const v1::ListChecksRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListChecks, request);
}

absl::StatusOr<v1::AddLoopClosureResponse> Client::AddLoopClosure(
    const v1::AddLoopClosureRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::AddLoopClosure, request);
}

absl::StatusOr<v1::ListLoopClosuresResponse> Client::ListLoopClosures(
    const v1::ListLoopClosuresRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListLoopClosures, request);
}

absl::StatusOr<v1::DeleteLoopClosureResponse> Client::DeleteLoopClosure(
    const v1::DeleteLoopClosureRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteLoopClosure, request);
}

absl::StatusOr<v1::FindContradictionsResponse> Client::FindContradictions(
    const v1::FindContradictionsRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::FindContradictions, request);
}

absl::StatusOr<v1::RejectCandidateResponse> Client::RejectCandidate(
    const v1::RejectCandidateRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::RejectCandidate, request);
}

absl::StatusOr<v1::ListRejectedCandidatesResponse>
Client::ListRejectedCandidates(
    const v1::ListRejectedCandidatesRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListRejectedCandidates, request);
}

absl::StatusOr<v1::DeleteRejectedCandidateResponse>
Client::DeleteRejectedCandidate(
    const v1::DeleteRejectedCandidateRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteRejectedCandidate, request);
}

absl::StatusOr<v1::ListDeletedPosePairsResponse> Client::ListDeletedPosePairs(
    const v1::ListDeletedPosePairsRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListDeletedPosePairs, request);
}

absl::StatusOr<v1::ListPosesResponse> Client::ListPoses(
    const v1::ListPosesRequest& request) const {
  if (request.as_columns() || request.has_read_mask()) {
    return rep_->Unary(Retry::kSafe, &Stub::ListPoses, request);
  }
  v1::ListPosesRequest asked = request;
  asked.set_as_columns(true);
  absl::StatusOr<v1::ListPosesResponse> page =
      rep_->Unary(Retry::kSafe, &Stub::ListPoses, asked);
  if (!page.ok()) return page;
  for (const v1::PoseColumns& columns : page->columns()) {
    const absl::Status status = AddPosesOf(columns, page->mutable_poses());
    if (!status.ok()) return status;
  }
  page->clear_columns();
  return page;
}

absl::StatusOr<v1::ListRecordingsResponse> Client::ListRecordings(
    const v1::ListRecordingsRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListRecordings, request);
}

absl::StatusOr<v1::AcceptDataLossResponse> Client::AcceptDataLoss(
    const v1::AcceptDataLossRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::AcceptDataLoss, request);
}

absl::StatusOr<v1::CreateGroupResponse> Client::CreateGroup(
    const v1::CreateGroupRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::CreateGroup, request);
}

absl::StatusOr<v1::GetGroupResponse> Client::GetGroup(
    const v1::GetGroupRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::GetGroup, request);
}

absl::StatusOr<v1::ListGroupsResponse> Client::ListGroups(
    const v1::ListGroupsRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListGroups, request);
}

absl::StatusOr<v1::UpdateGroupResponse> Client::UpdateGroup(
    const v1::UpdateGroupRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::UpdateGroup, request,
                     RevisionOf(request.expected_revision()));
}

absl::StatusOr<v1::DeleteGroupResponse> Client::DeleteGroup(
    const v1::DeleteGroupRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteGroup, request,
                     RevisionOf(request.expected_revision()));
}

absl::StatusOr<v1::AddGroupMemberResponse> Client::AddGroupMember(
    const v1::AddGroupMemberRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::AddGroupMember, request,
                     Revision::kAny);
}

absl::StatusOr<v1::UpdateGroupMemberResponse> Client::UpdateGroupMember(
    const v1::UpdateGroupMemberRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::UpdateGroupMember, request,
                     RevisionOf(request.expected_revision()));
}

absl::StatusOr<v1::RemoveGroupMemberResponse> Client::RemoveGroupMember(
    const v1::RemoveGroupMemberRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::RemoveGroupMember, request,
                     Revision::kAny);
}

absl::StatusOr<v1::ListGroupMembersResponse> Client::ListGroupMembers(
    const v1::ListGroupMembersRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListGroupMembers, request);
}

absl::StatusOr<v1::AddInterVehicleLoopClosureResponse>
Client::AddInterVehicleLoopClosure(
    const v1::AddInterVehicleLoopClosureRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::AddInterVehicleLoopClosure, request,
                     Revision::kAny);
}

absl::StatusOr<v1::ListInterVehicleLoopClosuresResponse>
Client::ListInterVehicleLoopClosures(
    const v1::ListInterVehicleLoopClosuresRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListInterVehicleLoopClosures,
                     request);
}

absl::StatusOr<v1::DeleteInterVehicleLoopClosureResponse>
Client::DeleteInterVehicleLoopClosure(
    const v1::DeleteInterVehicleLoopClosureRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteInterVehicleLoopClosure,
                     request, Revision::kAny);
}

absl::StatusOr<v1::RejectInterVehicleCandidateResponse>
Client::RejectInterVehicleCandidate(
    const v1::RejectInterVehicleCandidateRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::RejectInterVehicleCandidate, request,
                     Revision::kAny);
}

absl::StatusOr<v1::ListInterVehicleRejectedCandidatesResponse>
Client::ListInterVehicleRejectedCandidates(
    const v1::ListInterVehicleRejectedCandidatesRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListInterVehicleRejectedCandidates,
                     request);
}

absl::StatusOr<v1::DeleteInterVehicleRejectedCandidateResponse>
Client::DeleteInterVehicleRejectedCandidate(
    const v1::DeleteInterVehicleRejectedCandidateRequest& request) const {
  return rep_->Unary(Retry::kNever, &Stub::DeleteInterVehicleRejectedCandidate,
                     request, Revision::kAny);
}

absl::StatusOr<v1::ListFrameTransformsResponse> Client::ListFrameTransforms(
    const v1::ListFrameTransformsRequest& request) const {
  return rep_->Unary(Retry::kSafe, &Stub::ListFrameTransforms, request);
}

absl::StatusOr<v1::GetServerInfoResponse> Client::GetServerInfo() const {
  return rep_->Unary(Retry::kSafe, &Stub::GetServerInfo,
                     v1::GetServerInfoRequest());
}

absl::Status Client::ExportPoseGraph(
    const v1::ExportPoseGraphRequest& request,
    const std::function<absl::Status(const v1::ExportPoseGraphResponse&)>&
        visit) const {
  return rep_->Run(Retry::kSafe, rep_->options.bulk_deadline,
                   [&](grpc::ClientContext* context, bool* repeatable) {
                     const auto reader =
                         rep_->stub->ExportPoseGraph(context, request);
                     v1::ExportPoseGraphResponse part;
                     absl::Status visited;
                     while (visited.ok() && reader->Read(&part)) {
                       *repeatable = false;
                       visited = visit(part);
                     }
                     if (!visited.ok()) context->TryCancel();
                     const grpc::Status status = reader->Finish();
                     return visited.ok() ? FromGrpc(status) : visited;
                   });
}

absl::StatusOr<v1::RevisePosesResponse> Client::RevisePoses(
    const std::function<bool(v1::RevisePosesRequest*)>& next) const {
  v1::RevisePosesResponse response;
  const absl::Status status = rep_->Run(
      Retry::kNever, rep_->options.bulk_deadline,
      [&](grpc::ClientContext* context, bool* repeatable) {
        // `next` does not give its messages a second time.
        *repeatable = false;
        const auto writer = rep_->stub->RevisePoses(context, &response);
        v1::RevisePosesRequest request;
        while (next(&request) && writer->Write(request)) {
          request.Clear();
        }
        writer->WritesDone();
        return FromGrpc(writer->Finish());
      });
  if (!status.ok()) return status;
  return response;
}

}  // namespace revisit::client
