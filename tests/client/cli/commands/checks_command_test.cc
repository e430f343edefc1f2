#include "client/cli/commands/checks_command.h"

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

class ChecksCommandTest : public CommandTest {
 protected:
  ChecksCommandTest() {
    server_.set_checks(
        {CheckOf("a", 90,
                 {v1::CANDIDATE_STATE_CONFIRMED, v1::CANDIDATE_STATE_OPEN,
                  v1::CANDIDATE_STATE_OPEN}),
         CheckOf("a", 1000, {v1::CANDIDATE_STATE_WITHDRAWN}),
         CheckOf("a-b", 50, {v1::CANDIDATE_STATE_REJECTED})});
  }
};

TEST_F(ChecksCommandTest, ListHasAllPagesWithCountsAndTheBestCandidate) {
  ASSERT_TRUE(RunChecksList(client_, {"a", {}}, Text()).ok());
  EXPECT_EQ(out_.str(),
            "SEQUENCE  OPEN  CONFIRMED  REJECTED  WITHDRAWN  MATCHED_SEQ  "
            "PROBABILITY  VALUE m2  VERDICT   STORED\n"
            "      90     2          1         0          0           10  "
            "     0.9000     0.000  ACCEPTED  1970-01-01T00:00:00Z\n"
            "    1000     0          0         0          1           10  "
            "     0.9000     0.000  ACCEPTED  1970-01-01T00:00:00Z\n"
            "      50     0          0         1          0           10  "
            "     0.9000     0.000  ACCEPTED  1970-01-01T00:00:00Z\n");
  EXPECT_EQ(server_.CheckLists()[0].parent(), "vehicles/a");
}

TEST_F(ChecksCommandTest, ListOfAllVehiclesNamesThem) {
  ChecksOptions options = {"-", {}};
  options.filter.add_states(v1::CANDIDATE_STATE_OPEN);
  ASSERT_TRUE(RunChecksList(client_, options, Text()).ok());
  // The best one of those that are open.
  EXPECT_EQ(out_.str(),
            "VEHICLE     SEQUENCE  OPEN  CONFIRMED  REJECTED  WITHDRAWN  "
            "MATCHED_SEQ  PROBABILITY  VALUE m2  VERDICT    STORED\n"
            "vehicles/a        90     2          1         0          0  "
            "         20       0.0900     0.000  AMBIGUOUS  "
            "1970-01-01T00:00:00Z\n");
  EXPECT_EQ(server_.CheckLists()[0].parent(), "vehicles/-");
  EXPECT_EQ(server_.CheckLists()[0].filter().states(0),
            v1::CANDIDATE_STATE_OPEN);
}

TEST_F(ChecksCommandTest, AMatchInAnotherVehicleNamesIt) {
  v1::Check check = CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN});
  check.mutable_candidates()->mutable_candidates(0)->set_matched_vehicle(
      "vehicles/van");
  server_.set_checks({check});
  ASSERT_TRUE(RunChecksList(client_, {"a", {}}, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("  van@10  "));
}

TEST_F(ChecksCommandTest, NamesAndJsonAreThoseOfTheResources) {
  ASSERT_TRUE(RunChecksList(client_, {"-", {}}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/a/checks/90\nvehicles/a/checks/1000\n"
            "vehicles/a-b/checks/50\n");
  out_.str("");
  ASSERT_TRUE(RunChecksList(client_, {"-", {}}, Json()).ok());
  const auto list = nlohmann::json::parse(out_.str());
  EXPECT_EQ(list["checks"].size(), 3u);
  EXPECT_EQ(list["checks"][0]["states"][1]["state"], "CANDIDATE_STATE_OPEN");
  // Where a watch goes on.
  EXPECT_EQ(list["watchCursor"], "at 0");
}

TEST_F(ChecksCommandTest, OneCheckIsShownWithWhatBecameOfItsCandidates) {
  ASSERT_TRUE(RunChecksGet(client_, "a", 90, Text()).ok());
  EXPECT_THAT(out_.str(),
              HasSubstr("CANDIDATE  RANK  VALUE m2  STATE      CAUSE  SINCE  "
                        "               ACTOR  DECISION\n"
                        "        1     1     0.000  CONFIRMED  CHECK  "
                        "1970-01-01T00:01:00Z  -      -\n"));
  EXPECT_THAT(out_.str(), HasSubstr("query: node 0, sequence 90"));
  out_.str("");
  ASSERT_TRUE(RunChecksGet(client_, "a", 90, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/a/checks/90/candidates/1\n"
            "vehicles/a/checks/90/candidates/2\n"
            "vehicles/a/checks/90/candidates/3\n");
  EXPECT_EQ(ExitCodeOf(RunChecksGet(client_, "a", 91, Text())), 69);
}

class ValuedChecksTest : public CommandTest {
 protected:
  ValuedChecksTest() {
    first_ =
        CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_OPEN});
    first_.mutable_states(0)->set_value_square_meters(0.5);
    SearchAgain(&first_, 2, 0.25, 2.0);
    first_.mutable_states(1)->set_recommended(true);
    v1::Check second = CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN});
    second.mutable_states(0)->set_value_square_meters(0.125);
    v1::Check third = CheckOf(
        "a", 110, {v1::CANDIDATE_STATE_CONFIRMED, v1::CANDIDATE_STATE_OPEN});
    third.mutable_states(0)->set_value_square_meters(9.0);
    third.mutable_states(1)->set_value_square_meters(3.0);
    third.set_stale(true);
    server_.set_checks({first_, second, third});
    options_.order = v1::LIST_CHECKS_ORDER_BY_VALUE;
    options_.looks_per_kilometer = 2;
  }

  v1::Check first_;
  int server_pages_ = 0;
  ChecksOptions options_ = {"a", {}};
};

TEST_F(ValuedChecksTest, ByValueShowsTheMostValuableOpenCandidateOfEach) {
  ASSERT_TRUE(RunChecksList(client_, options_, Text()).ok());
  EXPECT_EQ(out_.str(),
            "SEQUENCE  OPEN  CONFIRMED  REJECTED  WITHDRAWN  LOOKS  "
            "MATCHED_SEQ  PROBABILITY  VALUE m2  VERDICT    STALE  STORED\n"
            "     110     1          1         0          0      0  "
            "         20       0.0900     3.000  AMBIGUOUS  yes    "
            "1970-01-01T00:00:00Z\n"
            "      90     2          0         0          0      1  "
            "         20       0.2500     2.000  AMBIGUOUS  -      "
            "1970-01-01T00:00:00Z\n"
            "     100     1          0         0          0      0  "
            "         10       0.9000     0.125  ACCEPTED   -      "
            "1970-01-01T00:00:00Z\n");
}

TEST_F(ValuedChecksTest, ContradictedCandidateIsShownWhateverItIsWorth) {
  first_.mutable_states(0)->set_cause(v1::CANDIDATE_CAUSE_CONTRADICTION);
  server_.set_checks({first_});
  ASSERT_TRUE(RunChecksList(client_, options_, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("     0.9000     0.500  ACCEPTED"));
}

TEST_F(ValuedChecksTest, ServerIsAskedForWhatTheFlagsSay) {
  options_.fresh_only = true;
  options_.filter.set_least_value_square_meters(0.5);
  ASSERT_TRUE(RunChecksList(client_, options_, Text()).ok());
  const v1::ListChecksRequest asked = server_.CheckLists()[0];
  EXPECT_EQ(asked.order(), v1::LIST_CHECKS_ORDER_BY_VALUE);
  EXPECT_TRUE(asked.fresh_only());
  EXPECT_EQ(asked.looks_per_kilometer(), 2);
  EXPECT_EQ(asked.filter().least_value_square_meters(), 0.5);
}

TEST_F(ValuedChecksTest, CheckThatMovesOverTheEdgeOfAPageIsListedOnce) {
  // Once the first page is read, its first check becomes the least valuable.
  server_.ChangeChecks([this](std::vector<v1::Check>* checks) {
    if (server_pages_++ == 1) {
      (*checks)[2].mutable_states(1)->set_value_square_meters(0.0625);
    }
  });
  ASSERT_TRUE(RunChecksList(client_, options_, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(), "vehicles/a/checks/110\nvehicles/a/checks/90\n");
}

TEST_F(ValuedChecksTest, OneCheckIsShownAsOfThenAndAsOfNow) {
  ASSERT_TRUE(RunChecksGet(client_, "a", 90, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("CANDIDATE  RANK  RANK NOW  VALUE m2"));
  EXPECT_THAT(out_.str(), HasSubstr("        2     2         1     2.000"));
  EXPECT_THAT(out_.str(), HasSubstr("        1     1         -     0.500"));
  const auto then = out_.str().find("told then, of revision 7:\n");
  const auto now = out_.str().find("found now, of revision 9:\n");
  ASSERT_NE(then, std::string::npos);
  ASSERT_NE(now, std::string::npos);
  EXPECT_THAT(out_.str().substr(then, now - then), HasSubstr("0.0900"));
  EXPECT_THAT(out_.str().substr(now), HasSubstr("0.2500"));
  EXPECT_EQ(out_.str().find("stale"), std::string::npos);
  out_.str("");
  ASSERT_TRUE(RunChecksGet(client_, "a", 110, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("stale: what this rests on has changed"));
  EXPECT_EQ(out_.str().find("told then"), std::string::npos);
}

}  // namespace
}  // namespace revisit::client
