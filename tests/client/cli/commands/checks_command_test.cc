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
            "PROBABILITY  VERDICT   STORED\n"
            "      90     2          1         0          0           10  "
            "     0.9000  ACCEPTED  1970-01-01T00:00:00Z\n"
            "    1000     0          0         0          1           10  "
            "     0.9000  ACCEPTED  1970-01-01T00:00:00Z\n"
            "      50     0          0         1          0           10  "
            "     0.9000  ACCEPTED  1970-01-01T00:00:00Z\n");
  EXPECT_EQ(server_.CheckLists()[0].parent(), "vehicles/a");
}

TEST_F(ChecksCommandTest, ListOfAllVehiclesNamesThem) {
  ChecksOptions options = {"-", {}};
  options.filter.add_states(v1::CANDIDATE_STATE_OPEN);
  ASSERT_TRUE(RunChecksList(client_, options, Text()).ok());
  // The best one of those that are open.
  EXPECT_EQ(out_.str(),
            "VEHICLE     SEQUENCE  OPEN  CONFIRMED  REJECTED  WITHDRAWN  "
            "MATCHED_SEQ  PROBABILITY  VERDICT    STORED\n"
            "vehicles/a        90     2          1         0          0  "
            "         20       0.0900  AMBIGUOUS  1970-01-01T00:00:00Z\n");
  EXPECT_EQ(server_.CheckLists()[0].parent(), "vehicles/-");
  EXPECT_EQ(server_.CheckLists()[0].filter().states(0),
            v1::CANDIDATE_STATE_OPEN);
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
              HasSubstr("CANDIDATE  RANK  STATE      CAUSE  SINCE             "
                        "    ACTOR  DECISION\n"
                        "        1     1  CONFIRMED  CHECK  1970-01-01T00:01:"
                        "00Z  -      -\n"));
  EXPECT_THAT(out_.str(), HasSubstr("query: node 0, sequence 90"));
  out_.str("");
  ASSERT_TRUE(RunChecksGet(client_, "a", 90, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/a/checks/90/candidates/1\n"
            "vehicles/a/checks/90/candidates/2\n"
            "vehicles/a/checks/90/candidates/3\n");
  EXPECT_EQ(ExitCodeOf(RunChecksGet(client_, "a", 91, Text())), 69);
}

}  // namespace
}  // namespace revisit::client
