#include "client/revisit/client.h"

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "client/revisit/channel.h"
#include "client/revisit/status.h"
#include "gmock/gmock.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "tests/client/fake_server.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

using std::chrono::milliseconds;
using ::testing::ElementsAre;
using ::testing::Pair;

ClientOptions WithFourAttempts() {
  ClientOptions options;
  options.max_attempts = 4;
  options.backoff.initial = milliseconds(1);
  options.backoff.max = milliseconds(5);
  return options;
}

class ClientTest : public ::testing::Test {
 protected:
  FakeServer server_;
  Client client_{MakeInsecureChannel(server_.address()), WithFourAttempts()};
};

grpc::Status StoreUnavailable() {
  return MakeStatus(grpc::StatusCode::UNAVAILABLE, "down",
                    {"STORE_UNAVAILABLE"});
}

v1::PoseBatch SomePoses(int count) {
  v1::PoseBatch batch;
  for (int i = 1; i <= count; ++i) {
    v1::Pose& pose = *batch.add_poses();
    pose.set_sequence(static_cast<std::uint64_t>(i));
    pose.mutable_local()->set_x_meters(0.1 * i);
    pose.set_heading_radians(-0.0);
    pose.mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (int k = 0; k < 6; ++k) pose.mutable_covariance()->add_values(k);
  }
  return batch;
}

TEST_F(ClientTest, RetriesReadsThatAreUnavailable) {
  server_.FailUnaryCalls({StoreUnavailable(), StoreUnavailable()});
  v1::GetVehicleRequest request;
  request.set_name("vehicles/a");
  const auto response = client_.GetVehicle(request);
  ASSERT_TRUE(response.ok()) << response.status();
  EXPECT_EQ(response->vehicle().name(), "vehicles/a");
  EXPECT_EQ(server_.unary_calls(), 3);
}

TEST_F(ClientTest, GivesUpAfterTheLastAttempt) {
  server_.FailUnaryCalls(std::vector<grpc::Status>(10, StoreUnavailable()));
  const auto response = client_.GetVehicle({});
  EXPECT_EQ(response.status().code(), absl::StatusCode::kUnavailable);
  EXPECT_EQ(DetailsOf(response.status()).reason, "STORE_UNAVAILABLE");
  EXPECT_EQ(server_.unary_calls(), 4);
}

TEST_F(ClientTest, NeverRepeatsADeletion) {
  server_.FailUnaryCalls({StoreUnavailable()});
  EXPECT_EQ(client_.DeleteVehicle({}).status().code(),
            absl::StatusCode::kUnavailable);
  EXPECT_EQ(server_.unary_calls(), 1);
}

TEST_F(ClientTest, RetriesARejectionSinceTheServerKeepsOne) {
  server_.FailUnaryCalls({StoreUnavailable()});
  v1::RejectCandidateRequest request;
  request.set_parent("vehicles/a");
  request.mutable_rejected_candidate()->set_query_sequence(9);
  const auto response = client_.RejectCandidate(request);
  ASSERT_TRUE(response.ok()) << response.status();
  EXPECT_EQ(response->rejected_candidate().query_sequence(), 9u);
  EXPECT_EQ(response->revision(), 8u);
  EXPECT_EQ(server_.unary_calls(), 2);
}

TEST_F(ClientTest, ListsRejectionsAndNeverRepeatsTheirDeletion) {
  v1::ListRejectedCandidatesRequest list;
  list.set_parent("vehicles/a");
  server_.FailUnaryCalls({StoreUnavailable()});
  const auto page = client_.ListRejectedCandidates(list);
  ASSERT_TRUE(page.ok()) << page.status();
  EXPECT_EQ(page->rejected_candidates(0).name(),
            "vehicles/a/rejectedCandidates/first");
  EXPECT_EQ(page->next_page_token(), "second page");
  EXPECT_EQ(server_.unary_calls(), 2);
  server_.FailUnaryCalls({StoreUnavailable()});
  EXPECT_EQ(client_.DeleteRejectedCandidate({}).status().code(),
            absl::StatusCode::kUnavailable);
  EXPECT_EQ(server_.unary_calls(), 3);
  EXPECT_EQ(client_.DeleteRejectedCandidate({})->revision(), 9u);
}

TEST_F(ClientTest, ListsWhatWasDeletedAlsoAfterAFailure) {
  v1::ListDeletedPosePairsRequest list;
  list.set_parent("vehicles/a");
  server_.FailUnaryCalls({StoreUnavailable()});
  const auto page = client_.ListDeletedPosePairs(list);
  ASSERT_TRUE(page.ok()) << page.status();
  EXPECT_EQ(page->deleted_pose_pairs(0).name(),
            "vehicles/a/deletedPosePairs/10");
  EXPECT_EQ(server_.unary_calls(), 2);
}

TEST_F(ClientTest, FindsContradictionsAlsoAfterAFailure) {
  v1::FindContradictionsResponse found;
  found.add_contradictions()->set_loop_closure("vehicles/a/loopClosures/1");
  server_.set_contradictions(found);
  server_.FailUnaryCalls({StoreUnavailable()});
  const auto answer = client_.FindContradictions({});
  ASSERT_TRUE(answer.ok()) << answer.status();
  EXPECT_EQ(answer->contradictions(0).loop_closure(),
            "vehicles/a/loopClosures/1");
  EXPECT_EQ(server_.unary_calls(), 2);
}

TEST_F(ClientTest, ReadsChecksAlsoAfterAFailure) {
  server_.set_checks({CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN}),
                      CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN}),
                      CheckOf("b", 20, {v1::CANDIDATE_STATE_OPEN})});
  v1::GetCheckRequest get;
  get.set_name("vehicles/a/checks/100");
  server_.FailUnaryCalls({StoreUnavailable()});
  const auto check = client_.GetCheck(get);
  ASSERT_TRUE(check.ok()) << check.status();
  EXPECT_EQ(check->check().name(), get.name());
  v1::ListChecksRequest list;
  list.set_parent("vehicles/-");
  server_.FailUnaryCalls({StoreUnavailable()});
  const auto page = client_.ListChecks(list);
  ASSERT_TRUE(page.ok()) << page.status();
  EXPECT_EQ(page->checks_size(), 2);
  EXPECT_EQ(page->watch_cursor(), "at 0");
  EXPECT_EQ(server_.unary_calls(), 4);
}

grpc::Status NotOwner() {
  return MakeStatus(grpc::StatusCode::UNAVAILABLE, "elsewhere",
                    {"NOT_OWNER", {{"owner", "10.0.0.2:50051"}}});
}

// The address in base64; see owner_route.h.
constexpr char kOwnersRoute[] = "MTAuMC4wLjI6NTAwNTE=";

TEST_F(ClientTest, AsksTheOwnerOfAVehicleNextAndNamesItOnlyOnce) {
  server_.FailUnaryCalls({NotOwner(), StoreUnavailable()});
  EXPECT_TRUE(client_.GetVehicle({}).ok());
  EXPECT_TRUE(client_.GetVehicle({}).ok());
  EXPECT_THAT(server_.Routes(), ElementsAre("", kOwnersRoute, "", ""));
}

TEST_F(ClientTest, FollowsAVehicleThatIsElsewhereUntilTheDeadline) {
  server_.FailUnaryCalls(std::vector<grpc::Status>(20, NotOwner()));
  EXPECT_TRUE(client_.GetVehicle({}).ok());
  EXPECT_EQ(server_.unary_calls(), 21);
}

TEST_F(ClientTest, RepeatsADeletionOfAVehicleThatIsElsewhere) {
  server_.FailUnaryCalls({NotOwner(), MakeStatus(grpc::StatusCode::ABORTED,
                                                 "moved", {"EPOCH_FENCED"})});
  EXPECT_TRUE(client_.DeleteVehicle({}).ok());
  EXPECT_THAT(server_.Routes(), ElementsAre("", kOwnersRoute, ""));
  // A status behind such an answer is judged by itself.
  server_.FailUnaryCalls({NotOwner(), StoreUnavailable()});
  EXPECT_EQ(client_.DeleteVehicle({}).status().code(),
            absl::StatusCode::kUnavailable);
}

TEST_F(ClientTest, WaitsForTheHistoriesOfAGroupUntilTheDeadline) {
  const grpc::Status not_ready = MakeStatus(
      grpc::StatusCode::UNAVAILABLE, "reads histories", {"GROUP_NOT_READY"});
  server_.FailUnaryCalls(std::vector<grpc::Status>(20, not_ready));
  EXPECT_TRUE(client_.FindCandidates({}).ok());
  EXPECT_EQ(server_.unary_calls(), 21);
}

TEST_F(ClientTest, RepeatsOfTheCallsAboutGroupsThoseThatAnswerTheSameAgain) {
  v1::CreateGroupRequest create;
  create.set_group_id("depot");
  v1::GetGroupRequest get;
  get.set_name("groups/depot");
  v1::AddGroupMemberRequest member;
  member.set_parent("groups/depot");
  v1::ListGroupMembersRequest members;
  members.set_parent("groups/depot");
  v1::AddInterVehicleLoopClosureRequest link;
  link.set_parent("groups/depot");
  v1::ListInterVehicleLoopClosuresRequest links;
  links.set_parent("groups/depot");
  v1::RejectInterVehicleCandidateRequest reject;
  reject.set_parent("groups/depot");
  v1::ListInterVehicleRejectedCandidatesRequest rejected;
  rejected.set_parent("groups/depot");
  v1::ListFrameTransformsRequest frames;
  frames.set_parent("groups/depot");
  const std::vector<std::function<absl::Status()>> repeated = {
      [&] { return client_.CreateGroup(create).status(); },
      [&] { return client_.GetGroup(get).status(); },
      [&] { return client_.ListGroups({}).status(); },
      [&] { return client_.AddGroupMember(member).status(); },
      [&] { return client_.ListGroupMembers(members).status(); },
      [&] { return client_.AddInterVehicleLoopClosure(link).status(); },
      [&] { return client_.ListInterVehicleLoopClosures(links).status(); },
      [&] { return client_.RejectInterVehicleCandidate(reject).status(); },
      [&] {
        return client_.ListInterVehicleRejectedCandidates(rejected).status();
      },
      [&] { return client_.ListFrameTransforms(frames).status(); }};
  for (std::size_t i = 0; i < repeated.size(); ++i) {
    server_.FailUnaryCalls({StoreUnavailable()});
    EXPECT_EQ(repeated[i](), absl::OkStatus()) << i;
  }
}

TEST_F(ClientTest, NeverRepeatsWhatMayUndoAChangeOfAGroupByOthers) {
  v1::CreateGroupRequest create;
  create.set_group_id("depot");
  ASSERT_TRUE(client_.CreateGroup(create).ok());
  v1::UpdateGroupRequest update;
  update.mutable_group()->set_name("groups/depot");
  v1::UpdateGroupMemberRequest datum;
  datum.mutable_member()->set_name("groups/depot/members/a");
  v1::RemoveGroupMemberRequest member;
  member.set_name("groups/depot/members/a");
  v1::DeleteInterVehicleLoopClosureRequest link;
  link.set_name("groups/depot/loopClosures/1");
  v1::DeleteInterVehicleRejectedCandidateRequest rejected;
  rejected.set_name("groups/depot/rejectedCandidates/1");
  const std::vector<std::function<absl::Status()>> once = {
      [&] { return client_.UpdateGroup(update).status(); },
      [&] { return client_.UpdateGroupMember(datum).status(); },
      [&] { return client_.RemoveGroupMember(member).status(); },
      [&] { return client_.DeleteInterVehicleLoopClosure(link).status(); },
      [&] {
        return client_.DeleteInterVehicleRejectedCandidate(rejected).status();
      },
      [&] { return client_.DeleteGroup({}).status(); }};
  for (std::size_t i = 0; i < once.size(); ++i) {
    server_.FailUnaryCalls({StoreUnavailable()});
    EXPECT_EQ(once[i]().code(), absl::StatusCode::kUnavailable) << i;
  }
}

TEST_F(ClientTest, RepeatsAChangeOfAGroupThatLostToOthersUnlessForARevision) {
  const std::vector<grpc::Status> lost(
      2, MakeStatus(grpc::StatusCode::ABORTED, "at 7", {"REVISION_MISMATCH"}));
  v1::CreateGroupRequest create;
  create.set_group_id("depot");
  ASSERT_TRUE(client_.CreateGroup(create).ok());
  v1::RemoveGroupMemberRequest member;
  member.set_name("groups/depot/members/a");
  server_.FailUnaryCalls(lost);
  EXPECT_TRUE(client_.RemoveGroupMember(member).ok());
  v1::UpdateGroupRequest update;
  update.mutable_group()->set_name("groups/depot");
  server_.FailUnaryCalls(lost);
  EXPECT_TRUE(client_.UpdateGroup(update).ok());
  update.set_expected_revision(3);
  server_.FailUnaryCalls({lost[0]});
  EXPECT_TRUE(absl::IsAborted(client_.UpdateGroup(update).status()));
}

TEST_F(ClientTest, ListsPosesInEitherFormThatAServerAnswers) {
  v1::PoseBatch stored = SomePoses(3);
  // This pose has a stamp, unlike the others.
  stored.mutable_poses(1)->mutable_stamp()->set_seconds(7);
  server_.Replace("uid", stored);
  v1::ListPosesRequest request;
  request.set_page_size(10);
  for (const bool knows_columns : {true, false}) {
    server_.TakeColumns(knows_columns);
    const auto page = client_.ListPoses(request);
    ASSERT_TRUE(page.ok()) << page.status();
    EXPECT_EQ(page->columns_size(), 0);
    ASSERT_EQ(page->poses_size(), 3);
    for (int i = 0; i < 3; ++i) {
      EXPECT_EQ(page->poses(i).SerializeAsString(),
                stored.poses(i).SerializeAsString());
    }
    EXPECT_EQ(server_.column_pages(), 1);
  }
}

TEST_F(ClientTest, LeavesPagesOfPosesAsTheCallerAsksForThem) {
  server_.Replace("uid", SomePoses(2));
  v1::ListPosesRequest request;
  request.set_page_size(10);
  request.set_as_columns(true);
  EXPECT_EQ(client_.ListPoses(request)->columns_size(), 1);
  request.set_as_columns(false);
  request.mutable_read_mask()->add_paths("sequence");
  EXPECT_EQ(client_.ListPoses(request)->poses_size(), 2);
  EXPECT_EQ(server_.column_pages(), 1);
}

TEST_F(ClientTest, RetriesNoOtherCode) {
  for (const auto code :
       {grpc::StatusCode::ABORTED, grpc::StatusCode::NOT_FOUND,
        grpc::StatusCode::RESOURCE_EXHAUSTED}) {
    const int before = server_.unary_calls();
    server_.FailUnaryCalls({MakeStatus(code, "no")});
    EXPECT_EQ(client_.GetVehicle({}).status().code(),
              static_cast<absl::StatusCode>(code));
    EXPECT_EQ(server_.unary_calls(), before + 1);
  }
}

TEST_F(ClientTest, RetriesACallThatWasCutOnItsWay) {
  // From gRPC or a proxy these come without a reason; with one they are the
  // server's word.
  for (const auto& [code, name] :
       {std::pair(grpc::StatusCode::CANCELLED, "CANCELLED"),
        std::pair(grpc::StatusCode::INTERNAL, "INTERNAL")}) {
    const int before = server_.unary_calls();
    server_.FailUnaryCalls({MakeStatus(code, "cut")});
    EXPECT_TRUE(client_.GetVehicle({}).ok()) << name;
    EXPECT_EQ(server_.unary_calls(), before + 2) << name;
    server_.FailUnaryCalls({MakeStatus(code, "told", {name})});
    EXPECT_EQ(client_.GetVehicle({}).status().code(),
              static_cast<absl::StatusCode>(code));
    EXPECT_EQ(server_.unary_calls(), before + 3) << name;
  }
}

TEST_F(ClientTest, DoesNotRetryACutCallThatIsNotSafeToRepeat) {
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::INTERNAL, "cut")});
  EXPECT_TRUE(absl::IsInternal(client_.DeleteVehicle({}).status()));
  EXPECT_EQ(server_.unary_calls(), 1);
}

TEST_F(ClientTest, WaitsAsLongAsTheServerAsks) {
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining",
                                     {"", {}, {}, milliseconds(80)})});
  const auto start = std::chrono::steady_clock::now();
  EXPECT_TRUE(client_.GetVehicle({}).ok());
  EXPECT_GE(std::chrono::steady_clock::now() - start, milliseconds(80));
}

TEST_F(ClientTest, DoesNotWaitPastItsDeadline) {
  ClientOptions options = WithFourAttempts();
  options.deadline = milliseconds(30'000);
  const Client client(MakeInsecureChannel(server_.address()), options);
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining",
                                     {"", {}, {}, milliseconds(60'000)})});
  const auto start = std::chrono::steady_clock::now();
  EXPECT_EQ(client.GetVehicle({}).status().code(),
            absl::StatusCode::kUnavailable);
  EXPECT_LT(std::chrono::steady_clock::now() - start, milliseconds(30'000));
}

TEST_F(ClientTest, KeepsReasonMetadataAndFieldViolationsReadable) {
  server_.FailUnaryCalls({MakeStatus(
      grpc::StatusCode::INVALID_ARGUMENT, "2 fields",
      {"INVALID_FIELD",
       {{"request_id", "abc"}},
       {{"vehicle_id", "is empty"}, {"settings.max_candidates", "is 0"}},
       {}})});
  const absl::Status status = client_.CreateVehicle({}).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  const ErrorDetails details = DetailsOf(status);
  EXPECT_EQ(details.reason, "INVALID_FIELD");
  EXPECT_EQ(details.domain, "revisit");
  EXPECT_THAT(details.metadata, ElementsAre(Pair("request_id", "abc")));
  ASSERT_EQ(details.field_violations.size(), 2u);
  EXPECT_EQ(details.field_violations[1].field, "settings.max_candidates");
  EXPECT_FALSE(details.retry_delay.has_value());
  EXPECT_EQ(Describe(status),
            "INVALID_ARGUMENT (INVALID_FIELD): 2 fields\n"
            "  vehicle_id: is empty\n"
            "  settings.max_candidates: is 0");
}

TEST_F(ClientTest, ReadsStatusesWithoutDetails) {
  const ErrorDetails details = DetailsOf(absl::UnavailableError("gone"));
  EXPECT_EQ(details.reason, "");
  EXPECT_TRUE(details.field_violations.empty());
  EXPECT_EQ(Describe(absl::UnavailableError("gone")), "UNAVAILABLE: gone");
}

TEST_F(ClientTest, VisitsTheExportAndStopsWhereTheVisitorSays) {
  int parts = 0;
  const auto count = [&](const v1::ExportPoseGraphResponse&) {
    ++parts;
    return absl::OkStatus();
  };
  EXPECT_TRUE(client_.ExportPoseGraph({}, count).ok());
  EXPECT_EQ(parts, 2);
  const absl::Status stopped =
      client_.ExportPoseGraph({}, [](const v1::ExportPoseGraphResponse&) {
        return absl::OutOfRangeError("enough");
      });
  EXPECT_EQ(stopped, absl::OutOfRangeError("enough"));
}

TEST_F(ClientTest, DoesNotRepeatAnExportOfWhichAPartHasCome) {
  server_.FailUnaryCalls({StoreUnavailable()});
  int parts = 0;
  const absl::Status status =
      client_.ExportPoseGraph({}, [&](const v1::ExportPoseGraphResponse&) {
        ++parts;
        return absl::OkStatus();
      });
  EXPECT_EQ(status.code(), absl::StatusCode::kUnavailable);
  EXPECT_EQ(parts, 2);
}

TEST(BackoffTest, GrowsToItsLimitWithinTheJitter) {
  BackoffOptions options;
  options.initial = milliseconds(100);
  options.max = milliseconds(500);
  options.multiplier = 2.0;
  options.jitter = 0.5;
  constexpr std::uint64_t kSeed = 7;
  Backoff backoff(options, kSeed);
  for (const int longest : {100, 200, 400, 500, 500}) {
    const auto wait = backoff.Next(std::nullopt);
    EXPECT_LE(wait, milliseconds(longest));
    EXPECT_GE(wait, milliseconds(longest / 2));
  }
  backoff.Reset();
  EXPECT_LE(backoff.Next(std::nullopt), milliseconds(100));
  const auto asked = backoff.Next(milliseconds(1000));
  EXPECT_GE(asked, milliseconds(1000));
  EXPECT_LE(asked, milliseconds(1100));
}

}  // namespace
}  // namespace revisit::client
