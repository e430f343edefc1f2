#include "client/cli/commands/deletions_command.h"

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

class DeletionsCommandTest : public CommandTest {};

TEST_F(DeletionsCommandTest, ListHasAllPagesTheLastDeletionFirst) {
  ASSERT_TRUE(RunDeletionsList(client_, "shuttle", Text()).ok());
  EXPECT_EQ(out_.str(),
            "DELETED               DELETED_BY  DECISION   QUERY_SEQ  "
            "MATCHED_SEQ  CREATED               DECIDED_BY  NOTE\n"
            "1970-01-01T00:00:00Z  token:tom   confirmed        150  "
            "         20  1970-01-01T00:00:00Z  token:eva\n"
            "1970-01-01T00:00:00Z  -           rejected         160  "
            "          0  1970-01-01T00:00:00Z  -           a bridge  above\n");
}

TEST_F(DeletionsCommandTest, NamesAndJsonAreThoseOfTheResources) {
  ASSERT_TRUE(
      RunDeletionsList(client_, "shuttle", As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/shuttle/deletedPosePairs/10\n"
            "vehicles/shuttle/deletedPosePairs/9\n");
  out_.str("");
  ASSERT_TRUE(RunDeletionsList(client_, "shuttle", Json()).ok());
  const auto listed = nlohmann::json::parse(out_.str())["deletedPosePairs"];
  EXPECT_EQ(listed[0]["loopClosure"]["querySequence"], 150);
  EXPECT_EQ(listed[0]["deletedBy"], "token:tom");
  EXPECT_EQ(listed[1]["rejectedCandidate"]["note"], "a bridge\n\tabove");
}

}  // namespace
}  // namespace revisit::client
