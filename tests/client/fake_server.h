// A server of revisit.v1.PoseGraphService that lives in the test and misbehaves
// on command. It keeps the promises of the proto that the client relies on:
// poses are a prefix without gaps, resent poses are compared, an answer tells
// what is durable.
#ifndef REVISIT_TESTS_CLIENT_FAKE_SERVER_H_
#define REVISIT_TESTS_CLIENT_FAKE_SERVER_H_

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "grpcpp/server.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"

namespace revisit::client {

struct StatusDetails {
  std::string reason;
  std::vector<std::pair<std::string, std::string>> metadata = {};
  // Field, description.
  std::vector<std::pair<std::string, std::string>> violations = {};
  std::optional<std::chrono::milliseconds> retry_delay = {};
};

// A status as the real server makes it.
grpc::Status MakeStatus(grpc::StatusCode code, const std::string& message,
                        const StatusDetails& details = {});

// The end of the stream at one step, if any.
struct StreamFault {
  enum class Kind {
    kNone,
    // Ends the stream with `status`, before the batch is stored.
    kBefore,
    // Stores the batch, then ends the stream with `status`: the ack is lost.
    kLoseAck,
    // Ends the stream with `status` after the ack, before candidates.
    kAfterAck,
    // Says nothing more and waits for the client to go.
    kSilence,
  };
  Kind kind = Kind::kNone;
  grpc::Status status;
};

// Where a watch of candidates is.
struct WatchStep {
  // That of the request.
  std::string cursor;
  // Events that this watch was told; 0 before anything is said.
  int told = 0;
};

// How a list goes on behind its last page, for ever unless it ends.
enum class ListEnd {
  kEnds,
  // The last page again, which names itself as the next one.
  kRepeats,
  // The last page again, each time under a token of its own.
  kRepeatsUnderFreshTokens,
  // Empty pages from the first on, each under a token of its own.
  kEmptyPages,
};

class FakeServer final : public v1::PoseGraphService::Service {
 public:
  FakeServer();
  ~FakeServer() override;

  const std::string& address() const { return address_; }

  // Stops as a crash does, open streams included; what is stored stays.
  void Stop();
  // Starts again at the same address.
  void Start();

  // Asked before `opened` is sent.
  void FailOpens(std::function<StreamFault()> faults);
  // Asked for each batch.
  void FailBatches(std::function<StreamFault()> faults);
  // The next unary calls end with these, in order; then they succeed.
  void FailUnaryCalls(std::vector<grpc::Status> statuses);
  // While held, nothing that arrives on a stream is stored or answered.
  void HoldStreams(bool held);
  // As if the vehicle were deleted and made again by somebody else: with this
  // uid and these poses. The first is "first".
  void Replace(const std::string& uid, const v1::PoseBatch& poses);
  // Whether streams of another vehicle_uid are refused, as by the real one.
  void CheckUid(bool check);
  // Forgets poses after this one.
  void Forget(std::uint64_t durable_sequence);
  // Whether it answers DATA_LOSS to a client that knows more, as the real one.
  void CheckAckedSequence(bool check);
  // A check falls due at every so manieth pose; 0 for none.
  void set_check_interval(std::uint64_t poses);
  void set_max_batch_poses(int poses);
  void EndListsLike(ListEnd end);
  // Appends this to each name, and says it wherever the server says something
  // for people.
  void Say(const std::string& text);
  // The answer of searches and checks, but for the query.
  void set_candidates(const v1::CandidateSet& candidates);

  // ListChecks() lists those of these that have a candidate in one of the
  // filter's states, two on a page, by value where that is asked for. Decisions
  // that name a candidate close it, and their deletion opens it.
  void set_checks(std::vector<v1::Check> checks);
  // Called before each page of ListChecks() and each GetCheck(), with all
  // checks.
  void ChangeChecks(std::function<void(std::vector<v1::Check>*)> change);
  // FindContradictions() answers these.
  void set_contradictions(const v1::FindContradictionsResponse& found);
  // Tells this to all watches, whatever their filter is. The cursor behind it
  // is "at N" if it is the Nth.
  void AddEvent(v1::WatchCandidatesResponse event);
  // Asked for each watch before its first beat and after each event: a status
  // ends it.
  void FailWatches(
      std::function<std::optional<grpc::Status>(const WatchStep&)> faults);
  // ListRecordings() lists these, two on a page.
  void set_recordings(std::vector<v1::Recording> recordings);

  // The stored poses, serialized.
  std::vector<std::string> Stored() const;
  std::uint64_t durable_sequence() const;
  // acked_sequence of each open, in order.
  std::vector<std::uint64_t> Opens() const;
  // vehicle_uid of each open, in order.
  std::vector<std::string> OpenUids() const;
  // For each resumed stream whose first batch arrived: that batch's first
  // sequence less the durable one that `opened` told.
  std::vector<std::int64_t> FirstSteps() const;
  int unary_calls() const;
  // The header x-revisit-owner of each GetVehicle and DeleteVehicle, and of
  // each open, in order; "" where there was none.
  std::vector<std::string> Routes() const;
  // The cursor of each watch, in order.
  std::vector<std::string> WatchCursors() const;
  // What each page of ListChecks() was asked for.
  std::vector<v1::ListChecksRequest> CheckLists() const;
  // "confirm NAME QUERY-MATCHED" and "reject NAME QUERY-MATCHED" of each
  // decision about the candidate NAME, in order.
  std::vector<std::string> Decisions() const;
  // All requests to add a loop closure, in order.
  std::vector<v1::AddLoopClosureRequest> AddedClosures() const;
  // What each search was asked, in order.
  std::vector<v1::FindCandidatesRequest> Searches() const;
  v1::UpdateGroupRequest last_group_update() const;
  v1::ListFrameTransformsRequest last_frames() const;
  // From the first page of ListFrameTransforms() to the second, the group's
  // revision grows by this.
  void set_revision_step(std::uint64_t step);
  // Names that deletions asked for, in order.
  std::vector<std::string> Deleted() const;
  int largest_batch() const;
  // Whether it knows columns, as it does at first; how many batches came as
  // columns, and how many pages of poses it answered so.
  void TakeColumns(bool take);
  int column_batches() const;
  int column_pages() const;

  grpc::Status CreateVehicle(grpc::ServerContext*,
                             const v1::CreateVehicleRequest*,
                             v1::CreateVehicleResponse*) override;
  grpc::Status GetVehicle(grpc::ServerContext*, const v1::GetVehicleRequest*,
                          v1::GetVehicleResponse*) override;
  grpc::Status ListVehicles(grpc::ServerContext*,
                            const v1::ListVehiclesRequest*,
                            v1::ListVehiclesResponse*) override;
  // The settings named by the mask alone, in the name of the vehicle.
  grpc::Status UpdateVehicle(grpc::ServerContext*,
                             const v1::UpdateVehicleRequest*,
                             v1::UpdateVehicleResponse*) override;
  grpc::Status DeleteVehicle(grpc::ServerContext*,
                             const v1::DeleteVehicleRequest*,
                             v1::DeleteVehicleResponse*) override;
  grpc::Status FindCandidates(grpc::ServerContext*,
                              const v1::FindCandidatesRequest*,
                              v1::FindCandidatesResponse*) override;
  grpc::Status GetCheck(grpc::ServerContext*, const v1::GetCheckRequest*,
                        v1::GetCheckResponse*) override;
  grpc::Status ListChecks(grpc::ServerContext*, const v1::ListChecksRequest*,
                          v1::ListChecksResponse*) override;
  grpc::Status WatchCandidates(
      grpc::ServerContext*, const v1::WatchCandidatesRequest*,
      grpc::ServerWriter<v1::WatchCandidatesResponse>*) override;
  grpc::Status AddLoopClosure(grpc::ServerContext*,
                              const v1::AddLoopClosureRequest*,
                              v1::AddLoopClosureResponse*) override;
  grpc::Status RejectCandidate(grpc::ServerContext*,
                               const v1::RejectCandidateRequest*,
                               v1::RejectCandidateResponse*) override;
  // Two pages.
  grpc::Status ListRejectedCandidates(
      grpc::ServerContext*, const v1::ListRejectedCandidatesRequest*,
      v1::ListRejectedCandidatesResponse*) override;
  grpc::Status DeleteRejectedCandidate(
      grpc::ServerContext*, const v1::DeleteRejectedCandidateRequest*,
      v1::DeleteRejectedCandidateResponse*) override;
  // Two pages: the loop closure 150-20, and a rejection before it.
  grpc::Status ListDeletedPosePairs(grpc::ServerContext*,
                                    const v1::ListDeletedPosePairsRequest*,
                                    v1::ListDeletedPosePairsResponse*) override;
  // Two pages: 150-20; 160-30 and another of the same poses.
  grpc::Status ListLoopClosures(grpc::ServerContext*,
                                const v1::ListLoopClosuresRequest*,
                                v1::ListLoopClosuresResponse*) override;
  grpc::Status DeleteLoopClosure(grpc::ServerContext*,
                                 const v1::DeleteLoopClosureRequest*,
                                 v1::DeleteLoopClosureResponse*) override;
  grpc::Status FindContradictions(grpc::ServerContext*,
                                  const v1::FindContradictionsRequest*,
                                  v1::FindContradictionsResponse*) override;
  // Pages of what is stored.
  grpc::Status ListPoses(grpc::ServerContext*, const v1::ListPosesRequest*,
                         v1::ListPosesResponse*) override;
  grpc::Status ListRecordings(grpc::ServerContext*,
                              const v1::ListRecordingsRequest*,
                              v1::ListRecordingsResponse*) override;
  // Groups, in fake_groups.cc. They are kept as they were sent, and each change
  // raises the revision of its group. Lists have two on a page.
  grpc::Status CreateGroup(grpc::ServerContext*, const v1::CreateGroupRequest*,
                           v1::CreateGroupResponse*) override;
  grpc::Status GetGroup(grpc::ServerContext*, const v1::GetGroupRequest*,
                        v1::GetGroupResponse*) override;
  grpc::Status ListGroups(grpc::ServerContext*, const v1::ListGroupsRequest*,
                          v1::ListGroupsResponse*) override;
  grpc::Status UpdateGroup(grpc::ServerContext*, const v1::UpdateGroupRequest*,
                           v1::UpdateGroupResponse*) override;
  grpc::Status DeleteGroup(grpc::ServerContext*, const v1::DeleteGroupRequest*,
                           v1::DeleteGroupResponse*) override;
  grpc::Status AddGroupMember(grpc::ServerContext*,
                              const v1::AddGroupMemberRequest*,
                              v1::AddGroupMemberResponse*) override;
  grpc::Status UpdateGroupMember(grpc::ServerContext*,
                                 const v1::UpdateGroupMemberRequest*,
                                 v1::UpdateGroupMemberResponse*) override;
  grpc::Status RemoveGroupMember(grpc::ServerContext*,
                                 const v1::RemoveGroupMemberRequest*,
                                 v1::RemoveGroupMemberResponse*) override;
  grpc::Status ListGroupMembers(grpc::ServerContext*,
                                const v1::ListGroupMembersRequest*,
                                v1::ListGroupMembersResponse*) override;
  grpc::Status AddInterVehicleLoopClosure(
      grpc::ServerContext*, const v1::AddInterVehicleLoopClosureRequest*,
      v1::AddInterVehicleLoopClosureResponse*) override;
  grpc::Status RejectInterVehicleCandidate(
      grpc::ServerContext*, const v1::RejectInterVehicleCandidateRequest*,
      v1::RejectInterVehicleCandidateResponse*) override;
  grpc::Status ListInterVehicleRejectedCandidates(
      grpc::ServerContext*,
      const v1::ListInterVehicleRejectedCandidatesRequest*,
      v1::ListInterVehicleRejectedCandidatesResponse*) override;
  grpc::Status DeleteInterVehicleRejectedCandidate(
      grpc::ServerContext*,
      const v1::DeleteInterVehicleRejectedCandidateRequest*,
      v1::DeleteInterVehicleRejectedCandidateResponse*) override;
  grpc::Status ListFrameTransforms(grpc::ServerContext*,
                                   const v1::ListFrameTransformsRequest*,
                                   v1::ListFrameTransformsResponse*) override;
  grpc::Status ListInterVehicleLoopClosures(
      grpc::ServerContext*, const v1::ListInterVehicleLoopClosuresRequest*,
      v1::ListInterVehicleLoopClosuresResponse*) override;
  grpc::Status DeleteInterVehicleLoopClosure(
      grpc::ServerContext*, const v1::DeleteInterVehicleLoopClosureRequest*,
      v1::DeleteInterVehicleLoopClosureResponse*) override;
  grpc::Status GetServerInfo(grpc::ServerContext*,
                             const v1::GetServerInfoRequest*,
                             v1::GetServerInfoResponse*) override;
  grpc::Status ExportPoseGraph(
      grpc::ServerContext*, const v1::ExportPoseGraphRequest*,
      grpc::ServerWriter<v1::ExportPoseGraphResponse>*) override;
  grpc::Status StreamPoses(
      grpc::ServerContext*,
      grpc::ServerReaderWriter<v1::StreamPosesResponse,
                               v1::StreamPosesRequest>*) override;

 private:
  grpc::Status NextUnaryStatus();
  std::string Said() const;
  // Ends a page of a list that was asked for with this token.
  template <typename Page, typename Items>
  void EndPage(const std::string& token, Items* items, Page* page);
  // Makes columns of the poses of a page, unless one has none.
  void AnswerColumns(v1::ListPosesResponse* page);
  // Says what Say() wants in a vehicle.
  void Describe(v1::Vehicle* vehicle) const;
  void Describe(v1::Check* check) const;
  void Describe(v1::WatchCandidatesResponse* event) const;
  // Mutex must be held.
  void NoteRoute(const grpc::ServerContext& context);
  void NoteDeletion(const std::string& name);
  template <typename Pair>
  void NoteDecision(const std::string& decision, const std::string& candidate,
                    const Pair& pair, const std::string& made);
  struct Group {
    v1::Group group;
    std::map<std::string, v1::GroupMember> members;
    std::map<std::string, v1::InterVehicleLoopClosure> links;
    std::map<std::string, v1::InterVehicleRejectedCandidate> rejected;
  };
  // Null if there is none of this name, or of what is in it. Mutex must be
  // held.
  Group* GroupOf(const std::string& name);
  // Stores what is new of a batch. Mutex must be held.
  grpc::Status Store(const v1::PoseBatch& batch);

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::unique_ptr<grpc::Server> server_;
  std::string address_;
  std::function<StreamFault()> open_faults_;
  std::function<StreamFault()> batch_faults_;
  std::deque<grpc::Status> unary_statuses_;
  bool held_ = false;
  bool stopping_ = false;
  bool check_acked_ = true;
  bool check_uid_ = true;
  std::string uid_ = "first";
  ListEnd list_end_ = ListEnd::kEnds;
  int pages_ = 0;
  std::string said_;
  std::uint64_t check_interval_ = 0;
  int max_batch_poses_ = 1000;
  v1::CandidateSet candidates_;
  std::vector<v1::Recording> recordings_;
  std::vector<v1::Check> checks_;
  std::function<void(std::vector<v1::Check>*)> change_checks_;
  v1::FindContradictionsResponse contradictions_;
  std::vector<v1::AddLoopClosureRequest> added_closures_;
  std::vector<v1::WatchCandidatesResponse> events_;
  std::function<std::optional<grpc::Status>(const WatchStep&)> watch_faults_;
  std::vector<std::string> watch_cursors_;
  std::vector<v1::ListChecksRequest> check_lists_;
  std::vector<std::string> decisions_;
  std::vector<std::string> stored_;
  std::vector<std::uint64_t> opens_;
  std::vector<std::string> open_uids_;
  std::vector<std::int64_t> first_steps_;
  int unary_calls_ = 0;
  std::vector<std::string> routes_;
  std::vector<std::string> deleted_;
  int largest_batch_ = 0;
  bool takes_columns_ = true;
  int column_batches_ = 0;
  int column_pages_ = 0;
  std::map<std::string, Group> groups_;
  std::vector<v1::FindCandidatesRequest> searches_;
  v1::UpdateGroupRequest last_group_update_;
  v1::ListFrameTransformsRequest last_frames_;
  std::uint64_t revision_step_ = 0;
};

template <typename Page, typename Items>
void FakeServer::EndPage(const std::string& token, Items* items, Page* page) {
  std::lock_guard<std::mutex> lock(mutex_);
  ++pages_;
  switch (list_end_) {
    case ListEnd::kEnds:
      return;
    case ListEnd::kRepeats:
      page->set_next_page_token(token.empty() ? "0" : token);
      return;
    case ListEnd::kEmptyPages:
      items->Clear();
      [[fallthrough]];
    case ListEnd::kRepeatsUnderFreshTokens:
      // Many digits, of which the pages of poses read the first.
      page->set_next_page_token("0." + std::to_string(pages_));
      return;
  }
}

}  // namespace revisit::client

#endif  // REVISIT_TESTS_CLIENT_FAKE_SERVER_H_
