// Loop closures between vehicles over the commands, against a fake server.
#include "client/cli/commands/link_command.h"

#include <string>
#include <vector>

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

class LinkCommandTest : public CommandTest {
 protected:
  void SetUp() override {
    v1::CreateGroupRequest request;
    request.set_group_id("depot");
    ASSERT_TRUE(client_.CreateGroup(request).ok());
  }

  absl::Status Line(const std::vector<const char*>& words,
                    const Terminal& terminal) {
    out_.str("");
    return RunLine(&AddLinkCommand, words, terminal);
  }
  absl::Status Line(const std::vector<const char*>& words) {
    return Line(words, Text());
  }
  // Three links, of which the last two have the same ends.
  void AddThree() {
    ASSERT_TRUE(Line({"link", "add", "depot", "b@310", "a@1072"}).ok());
    ASSERT_TRUE(Line({"link", "add", "depot", "b@400", "a@7"}).ok());
    ASSERT_TRUE(
        Line({"link", "add", "depot", "b@400", "a@7", "--id", "again"}).ok());
  }
};

TEST_F(LinkCommandTest, LinkIsAddedWithWhatWasMeasured) {
  ASSERT_TRUE(
      Line({"link", "add", "depot", "b@310", "vehicles/a@1072", "--relative",
            "1.25,-0.5,0.03", "--covariance", "0.04,0,0,0.04,0,0.0004",
            "--note", "icp", "--score", "0.75"})
          .ok());
  EXPECT_EQ(out_.str(), "linked groups/depot/loopClosures/1, revision 2\n");
  ASSERT_TRUE(Line({"link", "list", "depot"}).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("ID +QUERY +MATCHED +MEASURED +SCORE +"
                                        "CREATED +DECIDED_BY +NOTE\n"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("1 +b@310 +a@1072 +1.25 m, -0.50 m, 0.030 rad "
                            "+0.75 +1970-01-01T00:00:00Z +token:eva +icp\n"));
  ASSERT_TRUE(Line({"link", "list", "depot"}, Json()).ok());
  const json link = json::parse(out_.str())["loopClosures"][0];
  EXPECT_EQ(link["matched"],
            json({{"vehicle", "vehicles/a"}, {"sequence", 1072}}));
  EXPECT_EQ(link["measurement"]["covariance"]["form"],
            "COVARIANCE_FORM_PLANAR_6");
}

TEST_F(LinkCommandTest, LinkWithoutAMeasurementHasNone) {
  ASSERT_TRUE(Line({"link", "add", "depot", "b@310", "a@1072"}, Json()).ok());
  const json added = json::parse(out_.str());
  EXPECT_FALSE(added["loopClosure"].contains("measurement")) << added;
  EXPECT_FALSE(added["loopClosure"].contains("score")) << added;
  EXPECT_EQ(added["revision"], 2);
}

TEST_F(LinkCommandTest, WhatIsNoPoseOfAVehicleIsAWrongUsage) {
  for (const char* word : {"b", "@310", "b@", "b@0", "b@-1", "b@+1", "b@1.5",
                           "b@99999999999999999999"}) {
    const absl::Status status = Line({"link", "add", "depot", word, "a@1072"});
    EXPECT_EQ(ExitCodeOf(status), kExitUsage) << word;
    EXPECT_THAT(ErrorText(status), HasSubstr("VEHICLE@SEQUENCE, such as"));
  }
}

TEST_F(LinkCommandTest, MeasurementIsCheckedAsThatOfOneVehicle) {
  EXPECT_EQ(ExitCodeOf(Line({"link", "add", "depot", "b@310", "a@1072",
                             "--relative", "1,2,3"})),
            kExitUsage);
  EXPECT_EQ(
      ExitCodeOf(Line({"link", "add", "depot", "b@310", "a@1072", "--relative",
                       "1,2", "--covariance", "1,0,0,1,0,1"})),
      kExitUsage);
}

TEST_F(LinkCommandTest, CandidateIsRejectedListedAndUndone) {
  ASSERT_TRUE(Line({"link", "reject", "depot", "b@310", "a@1072", "--note",
                    "another\nhall"})
                  .ok());
  EXPECT_EQ(out_.str(),
            "rejected groups/depot/rejectedCandidates/1, revision 2\n");
  ASSERT_TRUE(
      Line({"link", "reject", "depot", "b@4", "a@7", "--id", "x"}).ok());
  ASSERT_TRUE(
      Line({"link", "reject", "depot", "b@5", "a@7", "--id", "y"}).ok());
  ASSERT_TRUE(Line({"link", "list", "depot", "--rejected"}).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("1 +b@310 +a@1072 +1970[^ ]+ +"
                                        "token:eva +another hall\n"));
  ASSERT_TRUE(
      Line({"link", "list", "depot", "--rejected"}, As(OutputFormat::kName))
          .ok());
  EXPECT_EQ(out_.str(),
            "groups/depot/rejectedCandidates/1\n"
            "groups/depot/rejectedCandidates/x\n"
            "groups/depot/rejectedCandidates/y\n");
  ASSERT_TRUE(Line({"link", "list", "depot"}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(), "");
  EXPECT_EQ(ExitCodeOf(Line({"link", "delete", "depot", "b@310", "a@1072"})),
            69);
  ASSERT_TRUE(
      Line({"link", "delete", "depot", "b@310", "a@1072", "--rejected"}).ok());
  EXPECT_EQ(out_.str(),
            "deleted groups/depot/rejectedCandidates/1, revision 5\n");
  ASSERT_TRUE(Line({"link", "delete", "depot", "x", "--rejected"}).ok());
  EXPECT_THAT(server_.Deleted(),
              ElementsAre("groups/depot/rejectedCandidates/1",
                          "groups/depot/rejectedCandidates/x"));
}

TEST_F(LinkCommandTest, ListHasAllPages) {
  AddThree();
  ASSERT_TRUE(Line({"link", "list", "depot"}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "groups/depot/loopClosures/1\ngroups/depot/loopClosures/2\n"
            "groups/depot/loopClosures/again\n");
}

TEST_F(LinkCommandTest, LinksBesideDamagedOnesAreListedAndDeleted) {
  AddThree();
  const std::vector<grpc::Status> damaged = {
      grpc::Status::OK,
      MakeStatus(grpc::StatusCode::DATA_LOSS, "a bad row", {"STORE_CORRUPT"})};
  server_.FailUnaryCalls(damaged);
  EXPECT_EQ(ExitCodeOf(Line({"link", "list", "depot"})), 79);
  EXPECT_THAT(out_.str(), ContainsRegex("1 +b@310 +a@1072"));
  server_.FailUnaryCalls(damaged);
  EXPECT_EQ(ExitCodeOf(Line({"link", "delete", "depot", "c@1", "d@2"})), 79);
  server_.FailUnaryCalls(damaged);
  EXPECT_TRUE(Line({"link", "delete", "depot", "b@310", "a@1072"}).ok());
}

TEST_F(LinkCommandTest, LinkIsDeletedByItsEndsItsIdOrItsName) {
  AddThree();
  ASSERT_TRUE(Line({"link", "delete", "depot", "b@310", "a@1072"}).ok());
  EXPECT_EQ(out_.str(), "deleted groups/depot/loopClosures/1, revision 5\n");
  ASSERT_TRUE(Line({"link", "delete", "depot", "again"}).ok());
  ASSERT_TRUE(
      Line({"link", "delete", "depot", "groups/depot/loopClosures/2"}).ok());
  EXPECT_THAT(server_.Deleted(), ElementsAre("groups/depot/loopClosures/1",
                                             "groups/depot/loopClosures/again",
                                             "groups/depot/loopClosures/2"));
}

TEST_F(LinkCommandTest, EndsOfNoLinkOrOfTwoDeleteNothing) {
  AddThree();
  const absl::Status none =
      Line({"link", "delete", "depot", "a@1072", "b@310"});
  EXPECT_EQ(ExitCodeOf(none), 69);
  EXPECT_THAT(ErrorText(none), HasSubstr("revisit link list depot shows"));
  const absl::Status two = Line({"link", "delete", "depot", "b@400", "a@7"});
  EXPECT_TRUE(absl::IsFailedPrecondition(two));
  EXPECT_THAT(ErrorText(two), HasSubstr("groups/depot/loopClosures/again"));
  EXPECT_THAT(server_.Deleted(), IsEmpty());
}

TEST_F(LinkCommandTest, WordsThatNameNoLinkOfTheGroupAreAWrongUsage) {
  for (const std::vector<const char*>& words :
       {std::vector<const char*>{"b@1", "a"},
        std::vector<const char*>{"b@1", "a@1", "c@1"},
        std::vector<const char*>{"groups/other/loopClosures/1"}}) {
    std::vector<const char*> line = {"link", "delete", "depot"};
    line.insert(line.end(), words.begin(), words.end());
    EXPECT_EQ(ExitCodeOf(Line(line)), kExitUsage);
  }
  EXPECT_THAT(server_.Deleted(), IsEmpty());
}

}  // namespace
}  // namespace revisit::client
