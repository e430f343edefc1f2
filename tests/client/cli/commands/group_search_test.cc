// Searches in a group over `revisit find`, against a fake server.
#include <chrono>
#include <string>
#include <vector>

#include "client/cli/commands/find_command.h"
#include "client/revisit/status.h"
#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using std::chrono::milliseconds;
using ::testing::ContainsRegex;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

class GroupSearchTest : public CommandTest {
 protected:
  absl::Status Line(const std::vector<const char*>& words,
                    const Terminal& terminal) {
    out_.str("");
    return RunLine(&AddFindCommand, words, terminal);
  }

  // One candidate of another vehicle and one of the vehicle itself.
  static v1::CandidateSet Found() {
    v1::CandidateSet set;
    set.mutable_query()->set_sequence(310);
    set.set_group_revision(9);
    v1::Candidate* const other = set.add_candidates();
    other->set_rank(1);
    other->mutable_matched()->set_sequence(1072);
    other->set_matched_vehicle("vehicles/shuttle-7");
    other->set_recording_of_match("vehicles/shuttle-7/recordings/5");
    other->set_frame_state(v1::FRAME_STATE_DATUM);
    other->set_verdict(v1::VERDICT_ACCEPTED);
    v1::Candidate* const own = set.add_candidates();
    own->set_rank(2);
    own->mutable_matched()->set_sequence(40);
    own->set_frame_state(v1::FRAME_STATE_SAME);
    v1::SearchedVehicle* const searched = set.add_searched();
    searched->set_vehicle("vehicles/shuttle-7");
    searched->set_node_count(1200);
    searched->set_last_sequence(2076);
    searched->mutable_lag()->set_nanos(400'000'000);
    return set;
  }

  static v1::UnsearchedVehicle Left(const std::string& vehicle,
                                    v1::UnsearchedReason reason) {
    v1::UnsearchedVehicle left;
    left.set_vehicle(vehicle);
    left.set_reason(reason);
    return left;
  }

  static grpc::Status NotReady(milliseconds wait) {
    return MakeStatus(grpc::StatusCode::UNAVAILABLE, "reads histories",
                      {"GROUP_NOT_READY", {}, {}, wait});
  }
};

TEST_F(GroupSearchTest, ScopeIsWhatTheFlagsSay) {
  ASSERT_TRUE(
      Line({"find", "shuttle-8", "--group", "depot", "--in",
            "shuttle-7,vehicles/shuttle-9", "--exclude-own", "--partial"},
           Text())
          .ok());
  const v1::SearchScope scope = server_.Searches().back().options().scope();
  EXPECT_EQ(scope.group(), "groups/depot");
  EXPECT_THAT(scope.vehicles(),
              ElementsAre("vehicles/shuttle-7", "vehicles/shuttle-9"));
  EXPECT_TRUE(scope.exclude_own());
  EXPECT_TRUE(scope.allow_partial());
}

TEST_F(GroupSearchTest, SearchWithoutAGroupHasNoScope) {
  ASSERT_TRUE(Line({"find", "shuttle-8"}, Text()).ok());
  EXPECT_FALSE(server_.Searches().back().options().has_scope());
  EXPECT_THAT(out_.str(), Not(HasSubstr("searched")));
  for (const auto& more : {std::vector<const char*>{"--in", "a"},
                           std::vector<const char*>{"--exclude-own"},
                           std::vector<const char*>{"--partial"}}) {
    std::vector<const char*> words = {"find", "shuttle-8"};
    words.insert(words.end(), more.begin(), more.end());
    EXPECT_EQ(ExitCodeOf(Line(words, Text())), kExitUsage);
  }
  EXPECT_EQ(
      ExitCodeOf(Line({"find", "a", "--group", "depot", "--in", "b,"}, Text())),
      kExitUsage);
  EXPECT_EQ(server_.Searches().size(), 1u);
}

TEST_F(GroupSearchTest, CandidatesNameTheirVehicles) {
  server_.set_candidates(Found());
  ASSERT_TRUE(Line({"find", "shuttle-8", "--group", "depot"}, Text()).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("RANK +VEHICLE +SEQUENCE"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("1 +vehicles/shuttle-7 +1072.* 5 +DATUM"));
  EXPECT_THAT(out_.str(), ContainsRegex("2 +itself +40"));
  EXPECT_THAT(
      out_.str(),
      HasSubstr("searched 1 other vehicle with 1200 nodes, as they were "
                "up to 0.4 s ago; revision 9 of the group\n"));
  EXPECT_THAT(out_.str(), Not(HasSubstr("not searched")));
  EXPECT_THAT(out_.str(), Not(HasSubstr("LAST SEQUENCE")));
}

TEST_F(GroupSearchTest, WideAnswerHasEachSearchedVehicle) {
  server_.set_candidates(Found());
  ASSERT_TRUE(
      Line({"find", "shuttle-8", "--group", "depot"}, As(OutputFormat::kWide))
          .ok());
  EXPECT_THAT(out_.str(),
              ContainsRegex("SEARCHED +NODES +LAST SEQUENCE +LAG s\n"
                            "vehicles/shuttle-7 +1200 +2076 +0.4\n"));
}

TEST_F(GroupSearchTest, NamesAreTheWordsThatALinkTakes) {
  server_.set_candidates(Found());
  ASSERT_TRUE(Line({"find", "vehicles/shuttle-8", "--group", "depot"},
                   As(OutputFormat::kName))
                  .ok());
  EXPECT_EQ(out_.str(), "shuttle-8@310 shuttle-7@1072\n310-40\n");
}

TEST_F(GroupSearchTest, PartialAnswerSaysWhatWasNotSearchedAndWhy) {
  v1::CandidateSet set;
  set.set_group_revision(3);
  set.set_empty_reason(v1::EMPTY_REASON_NO_HISTORY);
  for (int i = 0; i < 12; ++i) {
    *set.add_unsearched() =
        Left("vehicles/v" + std::to_string(i), v1::UNSEARCHED_REASON_NOT_READY);
  }
  *set.add_unsearched() =
      Left("vehicles/drone", v1::UNSEARCHED_REASON_STATE_SPACE);
  server_.set_candidates(set);
  ASSERT_TRUE(
      Line({"find", "a", "--group", "depot", "--partial"}, Text()).ok());
  EXPECT_THAT(out_.str(),
              HasSubstr("no candidates: there is no history before the "
                        "sequence\nsearched 0 other vehicles; revision 3"));
  EXPECT_THAT(out_.str(),
              HasSubstr("not searched, since the server has not read its "
                        "history yet: vehicles/v0, vehicles/v1, "));
  EXPECT_THAT(out_.str(), HasSubstr("vehicles/v9 and 2 more\n"));
  EXPECT_THAT(out_.str(), HasSubstr("not searched, since its state space is "
                                    "another one: vehicles/drone\n"));
  ASSERT_TRUE(
      Line({"find", "a", "--group", "depot", "--partial"}, Json()).ok());
  EXPECT_EQ(json::parse(out_.str())["unsearched"].size(), 13u);
}

TEST_F(GroupSearchTest, GroupThatIsNotReadyIsWaitedForBeyondAttempts) {
  server_.FailUnaryCalls(std::vector<grpc::Status>(8, NotReady({})));
  server_.set_candidates(Found());
  ASSERT_TRUE(Line({"find", "shuttle-8", "--group", "depot"}, Text()).ok());
  EXPECT_EQ(server_.Searches().size(), 9u);
}

TEST_F(GroupSearchTest, GroupThatWillNotBeReadyInTimeIsToldWithWhatHelps) {
  server_.FailUnaryCalls({NotReady(milliseconds(120'000))});
  const absl::Status status =
      Line({"find", "shuttle-8", "--group", "depot"}, Text());
  EXPECT_EQ(ExitCodeOf(status), 78);
  EXPECT_EQ(DetailsOf(status).reason, "GROUP_NOT_READY");
  EXPECT_THAT(ErrorText(status), HasSubstr("--partial"));
  EXPECT_EQ(server_.Searches().size(), 1u);
}

}  // namespace
}  // namespace revisit::client
