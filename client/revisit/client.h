// Calls of revisit.v1.PoseGraphService, with deadlines and retries. For streams
// of poses see pose_stream.h, for watching candidates candidate_watch.h.
//
// Errors come back as absl::Status with the server's code and message;
// DetailsOf() (status.h) reads reason and field violations from them. Nothing
// here throws or ends the process.
//
// Retries: a call that answers UNAVAILABLE, or was cut on its way (IsCut() in
// status.h), is made again if doing it twice is the same as doing it once (each
// call says so), after an exponential back-off with jitter, no sooner than the
// server's RetryInfo asks for, and only while the wait ends before the
// deadline. A call that answers NOT_OWNER or EPOCH_FENCED changed nothing,
// since its vehicle is another server's: every call but RevisePoses is then
// made again, as often as the deadline allows and as soon as RetryInfo says,
// with the owner's address for a proxy that routes by it. A search in a group
// that answers GROUP_NOT_READY, while the server reads histories, is made again
// as often as the deadline allows too. A change of a group for any revision
// that lost to changes of others (REVISION_MISMATCH) has changed nothing, and
// is made again like one that answers UNAVAILABLE. Nothing else is.
#ifndef REVISIT_CLIENT_REVISIT_CLIENT_H_
#define REVISIT_CLIENT_REVISIT_CLIENT_H_

#include <chrono>
#include <functional>
#include <memory>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/backoff.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace grpc {
class ChannelInterface;
}

namespace revisit::client {

struct ClientOptions {
  // For a unary call with all its attempts and waits.
  std::chrono::milliseconds deadline{30'000};
  // For ExportPoseGraph and RevisePoses.
  std::chrono::milliseconds bulk_deadline{600'000};
  // Attempts of a call that may be retried, the first included. At least 1.
  int max_attempts = 6;
  BackoffOptions backoff;
};

// Thread-safe: any number of threads may call at the same time. Calls block.
// The channel is shared and may serve streams as well.
class Client {
 public:
  explicit Client(const std::shared_ptr<grpc::ChannelInterface>& channel,
                  const ClientOptions& options = ClientOptions());
  ~Client();

  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  // Retried: the server answers the same request again with the same vehicle.
  absl::StatusOr<v1::CreateVehicleResponse> CreateVehicle(
      const v1::CreateVehicleRequest& request) const;
  // Retried.
  absl::StatusOr<v1::GetVehicleResponse> GetVehicle(
      const v1::GetVehicleRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListVehiclesResponse> ListVehicles(
      const v1::ListVehiclesRequest& request) const;
  // The client does not retry this: it could undo a change that another client
  // made meanwhile.
  absl::StatusOr<v1::UpdateVehicleResponse> UpdateVehicle(
      const v1::UpdateVehicleRequest& request) const;
  // The client does not retry this: it could delete a new vehicle of the same
  // name.
  absl::StatusOr<v1::DeleteVehicleResponse> DeleteVehicle(
      const v1::DeleteVehicleRequest& request) const;
  // Retried: sequences make resending safe.
  absl::StatusOr<v1::AppendPosesResponse> AppendPoses(
      const v1::AppendPosesRequest& request) const;
  // Retried.
  absl::StatusOr<v1::FindCandidatesResponse> FindCandidates(
      const v1::FindCandidatesRequest& request) const;
  // Retried.
  absl::StatusOr<v1::GetCheckResponse> GetCheck(
      const v1::GetCheckRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListChecksResponse> ListChecks(
      const v1::ListChecksRequest& request) const;
  // Retried: the same link again is the existing one.
  absl::StatusOr<v1::AddLoopClosureResponse> AddLoopClosure(
      const v1::AddLoopClosureRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListLoopClosuresResponse> ListLoopClosures(
      const v1::ListLoopClosuresRequest& request) const;
  // The client does not retry this: it could delete a new loop closure of the
  // same name.
  absl::StatusOr<v1::DeleteLoopClosureResponse> DeleteLoopClosure(
      const v1::DeleteLoopClosureRequest& request) const;
  // Retried.
  absl::StatusOr<v1::FindContradictionsResponse> FindContradictions(
      const v1::FindContradictionsRequest& request) const;
  // Retried: the same candidate again is the existing rejection.
  absl::StatusOr<v1::RejectCandidateResponse> RejectCandidate(
      const v1::RejectCandidateRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListRejectedCandidatesResponse> ListRejectedCandidates(
      const v1::ListRejectedCandidatesRequest& request) const;
  // The client does not retry this: it could delete a new rejection of the same
  // name.
  absl::StatusOr<v1::DeleteRejectedCandidateResponse> DeleteRejectedCandidate(
      const v1::DeleteRejectedCandidateRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListDeletedPosePairsResponse> ListDeletedPosePairs(
      const v1::ListDeletedPosePairsRequest& request) const;
  // Retried. The answer has `poses`, which come as columns from servers that
  // know them, unless the request itself asks for columns, or has a read mask.
  absl::StatusOr<v1::ListPosesResponse> ListPoses(
      const v1::ListPosesRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListRecordingsResponse> ListRecordings(
      const v1::ListRecordingsRequest& request) const;
  // The client does not retry this: it is an operator's decision about one
  // moment.
  absl::StatusOr<v1::AcceptDataLossResponse> AcceptDataLoss(
      const v1::AcceptDataLossRequest& request) const;
  // Retried: the server answers the same request again with the same group.
  absl::StatusOr<v1::CreateGroupResponse> CreateGroup(
      const v1::CreateGroupRequest& request) const;
  // Retried.
  absl::StatusOr<v1::GetGroupResponse> GetGroup(
      const v1::GetGroupRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListGroupsResponse> ListGroups(
      const v1::ListGroupsRequest& request) const;
  // The client does not retry this: it could undo a change that another client
  // made meanwhile.
  absl::StatusOr<v1::UpdateGroupResponse> UpdateGroup(
      const v1::UpdateGroupRequest& request) const;
  // The client does not retry this: it could delete a new group of the same
  // name.
  absl::StatusOr<v1::DeleteGroupResponse> DeleteGroup(
      const v1::DeleteGroupRequest& request) const;
  // Retried: the same member again is the existing one.
  absl::StatusOr<v1::AddGroupMemberResponse> AddGroupMember(
      const v1::AddGroupMemberRequest& request) const;
  // The client does not retry this: it could undo a change that another client
  // made meanwhile.
  absl::StatusOr<v1::UpdateGroupMemberResponse> UpdateGroupMember(
      const v1::UpdateGroupMemberRequest& request) const;
  // The client does not retry this: it could remove a vehicle that joined
  // again.
  absl::StatusOr<v1::RemoveGroupMemberResponse> RemoveGroupMember(
      const v1::RemoveGroupMemberRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListGroupMembersResponse> ListGroupMembers(
      const v1::ListGroupMembersRequest& request) const;
  // Retried, as AddLoopClosure.
  absl::StatusOr<v1::AddInterVehicleLoopClosureResponse>
  AddInterVehicleLoopClosure(
      const v1::AddInterVehicleLoopClosureRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListInterVehicleLoopClosuresResponse>
  ListInterVehicleLoopClosures(
      const v1::ListInterVehicleLoopClosuresRequest& request) const;
  // The client does not retry this: it could delete a new loop closure of the
  // same name.
  absl::StatusOr<v1::DeleteInterVehicleLoopClosureResponse>
  DeleteInterVehicleLoopClosure(
      const v1::DeleteInterVehicleLoopClosureRequest& request) const;
  // Retried, as RejectCandidate.
  absl::StatusOr<v1::RejectInterVehicleCandidateResponse>
  RejectInterVehicleCandidate(
      const v1::RejectInterVehicleCandidateRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListInterVehicleRejectedCandidatesResponse>
  ListInterVehicleRejectedCandidates(
      const v1::ListInterVehicleRejectedCandidatesRequest& request) const;
  // The client does not retry this: it could delete a new rejected candidate of
  // the same name.
  absl::StatusOr<v1::DeleteInterVehicleRejectedCandidateResponse>
  DeleteInterVehicleRejectedCandidate(
      const v1::DeleteInterVehicleRejectedCandidateRequest& request) const;
  // Retried.
  absl::StatusOr<v1::ListFrameTransformsResponse> ListFrameTransforms(
      const v1::ListFrameTransformsRequest& request) const;
  // Retried.
  absl::StatusOr<v1::GetServerInfoResponse> GetServerInfo() const;

  // Calls `visit` for each part of the graph; a status but OK from it ends the
  // export and is returned. Retried until the first part has come.
  absl::Status ExportPoseGraph(
      const v1::ExportPoseGraphRequest& request,
      const std::function<absl::Status(const v1::ExportPoseGraphResponse&)>&
          visit) const;

  // Sends the messages that `next` fills in, until it says false. Not retried.
  absl::StatusOr<v1::RevisePosesResponse> RevisePoses(
      const std::function<bool(v1::RevisePosesRequest*)>& next) const;

 private:
  struct Rep;
  const std::unique_ptr<Rep> rep_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_CLIENT_H_
