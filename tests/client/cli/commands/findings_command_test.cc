#include "client/cli/commands/findings_command.h"

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::ContainsRegex;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

class FindingsCommandTest : public CommandTest {};

TEST_F(FindingsCommandTest, ListsHaveAllPages) {
  ASSERT_TRUE(RunClosuresList(client_, "shuttle", Text()).ok());
  EXPECT_EQ(out_.str(),
            "ID      QUERY_SEQ  MATCHED_SEQ  CREATED               DECIDED_BY  "
            "NOTE\n"
            "150-20        150           20  1970-01-01T00:00:00Z  token:eva\n"
            "160-30        160           30  1970-01-01T00:00:00Z  -\n"
            "again         160           30  1970-01-01T00:00:00Z  -\n");
  out_.str("");
  ASSERT_TRUE(RunClosuresList(client_, "shuttle", Json()).ok());
  EXPECT_EQ(json::parse(out_.str())["loopClosures"][1]["querySequence"], 160);
  out_.str("");
  ASSERT_TRUE(RunRejectionsList(client_, "shuttle", Json()).ok());
  EXPECT_EQ(json::parse(out_.str())["rejectedCandidates"].size(), 2u);
}

TEST_F(FindingsCommandTest, NamesAreThoseOfTheResources) {
  const Terminal names = As(OutputFormat::kName);
  ASSERT_TRUE(RunRejectionsList(client_, "shuttle", names).ok());
  ASSERT_TRUE(
      RunClosuresDelete(client_, {"shuttle", {"150", "20"}}, names).ok());
  EXPECT_THAT(out_.str(),
              ContainsRegex("^(vehicles/shuttle/rejectedCandidates/[^/]+\n){2}"
                            "vehicles/shuttle/loopClosures/150-20\n$"));
}

TEST_F(FindingsCommandTest, NotesAreListedInOneLineAndInJsonAsTheyAre) {
  ASSERT_TRUE(RunRejectionsList(client_, "shuttle", Text()).ok());
  EXPECT_THAT(out_.str(),
              HasSubstr("1970-01-01T00:00:00Z  -           a bridge  above\n"));
  out_.str("");
  ASSERT_TRUE(RunRejectionsList(client_, "shuttle", Json()).ok());
  const json listed = json::parse(out_.str())["rejectedCandidates"];
  EXPECT_EQ(listed[1]["note"], "a bridge\n\tabove");
}

TEST_F(FindingsCommandTest, ClosureIsDeletedByItsPoses) {
  ASSERT_TRUE(
      RunClosuresDelete(client_, {"shuttle", {"150", "20"}}, Text()).ok());
  EXPECT_EQ(out_.str(),
            "deleted vehicles/shuttle/loopClosures/150-20, revision 10\n");
  EXPECT_THAT(server_.Deleted(),
              ElementsAre("vehicles/shuttle/loopClosures/150-20"));
}

TEST_F(FindingsCommandTest, FindingsAreDeletedByIdOrName) {
  ASSERT_TRUE(RunClosuresDelete(client_, {"shuttle", {"again"}}, Text()).ok());
  ASSERT_TRUE(RunRejectionsDelete(
                  client_,
                  {"shuttle", {"vehicles/shuttle/rejectedCandidates/x"}},
                  Text())
                  .ok());
  EXPECT_THAT(server_.Deleted(),
              ElementsAre("vehicles/shuttle/loopClosures/again",
                          "vehicles/shuttle/rejectedCandidates/x"));
}

TEST_F(FindingsCommandTest, PosesOfNoClosureAreToldAndNothingIsDeleted) {
  const absl::Status status =
      RunClosuresDelete(client_, {"shuttle", {"20", "150"}}, Text());
  EXPECT_EQ(ExitCodeOf(status), 69);
  EXPECT_EQ(ErrorText(status),
            "NOT_FOUND: vehicles/shuttle has no loop closure of the poses 20 "
            "and 150\nrevisit closures list shuttle shows those that it has; "
            "the later pose comes first");
  EXPECT_THAT(server_.Deleted(), IsEmpty());
}

TEST_F(FindingsCommandTest, PosesOfTwoClosuresDeleteNeither) {
  const absl::Status status =
      RunClosuresDelete(client_, {"shuttle", {"160", "30"}}, Text());
  EXPECT_TRUE(absl::IsFailedPrecondition(status));
  EXPECT_THAT(ErrorText(status),
              HasSubstr("vehicles/shuttle/loopClosures/again"));
  EXPECT_THAT(json::parse(ErrorToJson(status))["error"]["hint"],
              HasSubstr("name one by its id"));
  EXPECT_THAT(server_.Deleted(), IsEmpty());
}

}  // namespace
}  // namespace revisit::client
