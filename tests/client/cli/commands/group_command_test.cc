// Groups and their members over the commands, against a fake server.
#include "client/cli/commands/group_command.h"

#include <string>
#include <vector>

#include "client/cli/commands/member_commands.h"
#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::ContainsRegex;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class GroupCommandTest : public CommandTest {
 protected:
  absl::Status Line(const std::vector<const char*>& words,
                    const Terminal& terminal) {
    out_.str("");
    return RunLine(&AddGroupCommand, words, terminal);
  }
  absl::Status Line(const std::vector<const char*>& words) {
    return Line(words, Text());
  }
};

TEST_F(GroupCommandTest, GroupIsCreatedWithWhatIsGivenAndShown) {
  ASSERT_TRUE(Line({"group", "create", "site", "--display-name", "North",
                    "--geodetic-origin", "48.25,11.5,480", "--fix-bias", "3"})
                  .ok());
  for (const char* line :
       {"name +groups/site\n", "display name +North\n", "uid +uid-of-site\n",
        "revision +1\n",
        "geodetic origin +48.25000000 deg, 11.50000000 deg, 480.000 m\n",
        "fix bias +3 m\n"}) {
    EXPECT_THAT(out_.str(), ContainsRegex(line));
  }
  ASSERT_TRUE(Line({"group", "get", "groups/site"}, Json()).ok());
  const json group = json::parse(out_.str());
  EXPECT_EQ(group["settings"]["geodeticOrigin"]["heightMeters"], 480.0);
  EXPECT_EQ(group["settings"]["fixBiasMeters"], 3.0);
}

TEST_F(GroupCommandTest, GroupWithoutSettingsIsCreatedWithoutSettings) {
  ASSERT_TRUE(Line({"group", "create", "depot"}, Json()).ok());
  const json group = json::parse(out_.str());
  EXPECT_FALSE(group.contains("settings")) << group;
}

TEST_F(GroupCommandTest, OriginThatIsNotThreeNumbersIsAWrongUsage) {
  const absl::Status status =
      Line({"group", "create", "site", "--geodetic-origin", "48.25,11.5"});
  EXPECT_EQ(ExitCodeOf(status), kExitUsage);
  EXPECT_THAT(ErrorText(status),
              HasSubstr("--geodetic-origin: expected LAT,LON,HEIGHT, got 2"));
}

TEST_F(GroupCommandTest, ListsHaveAllPages) {
  for (const char* id : {"a", "b", "c"}) {
    ASSERT_TRUE(Line({"group", "create", id}).ok());
  }
  ASSERT_TRUE(Line({"group", "list"}).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("GROUP +REVISION +GEODETIC ORIGIN"));
  EXPECT_THAT(out_.str(), ContainsRegex("groups/c +1 +- +0 m +unknown"));
  ASSERT_TRUE(Line({"group", "list"}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(), "groups/a\ngroups/b\ngroups/c\n");
  ASSERT_TRUE(Line({"group", "list"}, Json()).ok());
  EXPECT_EQ(json::parse(out_.str())["groups"].size(), 3u);
}

TEST_F(GroupCommandTest, UpdateNamesWhatIsGivenAndNothingElse) {
  ASSERT_TRUE(Line({"group", "create", "site", "--geodetic-origin",
                    "48.25,11.5,480", "--fix-bias", "3"})
                  .ok());
  ASSERT_TRUE(Line({"group", "update", "site", "--fix-bias", "5",
                    "--expected-revision", "1"})
                  .ok());
  EXPECT_THAT(server_.last_group_update().update_mask().paths(),
              ElementsAre("settings.fix_bias_meters"));
  EXPECT_EQ(server_.last_group_update().expected_revision(), 1u);
  EXPECT_THAT(out_.str(), HasSubstr("48.25000000 deg"));
  ASSERT_TRUE(Line({"group", "update", "site", "--no-geodetic-origin",
                    "--display-name", ""})
                  .ok());
  EXPECT_THAT(server_.last_group_update().update_mask().paths(),
              ElementsAre("display_name", "settings.geodetic_origin"));
  EXPECT_THAT(out_.str(), ContainsRegex("geodetic origin +none\n"
                                        "fix bias +5 m\n"));
}

TEST_F(GroupCommandTest, UpdateOfNothingIsAWrongUsage) {
  EXPECT_EQ(ExitCodeOf(Line({"group", "update", "site"})), kExitUsage);
  EXPECT_EQ(ExitCodeOf(Line({"group", "update", "site", "--no-geodetic-origin",
                             "--geodetic-origin", "1,2,3"})),
            kExitUsage);
}

TEST_F(GroupCommandTest, FramesAreToldOfAllPagesThatFitTogether) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  for (const char* vehicle : {"a", "b", "c"}) {
    ASSERT_TRUE(Line({"group", "add", "depot", vehicle}).ok());
  }
  const std::vector<const char*> frames = {"group", "frames", "depot", "--from",
                                           "b"};
  ASSERT_TRUE(Line(frames).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("RECORDING +LOOPS +FRAME +FRAME X m"));
  EXPECT_THAT(out_.str(), ContainsRegex("vehicles/a/recordings/1 +3 +KNOWN "
                                        "+12.50 +0.00 +0.0000\n"));
  EXPECT_THAT(out_.str(), HasSubstr("vehicles/c/recordings/1"));
  ASSERT_TRUE(Line(frames, As(OutputFormat::kWide)).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("vehicles/c/recordings/1 .* 2\\.0+ +"
                                        "3\\.0+ +- +0\\.1[0 ]+ +0.00 +7.00"));
  ASSERT_TRUE(Line(frames, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/a/recordings/1\nvehicles/b/recordings/1\n"
            "vehicles/c/recordings/1\n");
  ASSERT_TRUE(Line({"group", "frames", "depot", "--from", "b", "--in", "a,c",
                    "--partial"},
                   Json())
                  .ok());
  const json all = json::parse(out_.str());
  EXPECT_EQ(all["frameTransforms"].size(), 3u);
  EXPECT_EQ(all["groupRevision"], 4);
  EXPECT_THAT(server_.last_frames().vehicles(),
              ElementsAre("vehicles/a", "vehicles/c"));
  EXPECT_EQ(server_.last_frames().vehicle(), "vehicles/b");
  EXPECT_TRUE(server_.last_frames().allow_partial());
  server_.set_revision_step(1);
  EXPECT_TRUE(absl::IsAborted(Line(frames)));
  EXPECT_EQ(out_.str(), "");
  EXPECT_EQ(ExitCodeOf(Line({"group", "frames", "depot"})), kExitUsage);
}

TEST_F(GroupCommandTest, DeletionMayBeForOneRevisionOfOneGroup) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  EXPECT_EQ(ExitCodeOf(Line({"group", "delete", "depot", "site", "--yes",
                             "--expected-revision", "3"})),
            kExitUsage);
  EXPECT_TRUE(absl::IsAborted(
      Line({"group", "delete", "depot", "--yes", "--expected-revision", "3"})));
  EXPECT_TRUE(
      Line({"group", "delete", "depot", "--yes", "--expected-revision", "1"})
          .ok());
}

TEST_F(GroupCommandTest, DeletionAsksForTheIdAndSaysWhatGoes) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  std::vector<std::string> questions;
  const auto answering = [&questions](const std::string& answer) {
    return [&questions, answer](const std::string& question) {
      questions.push_back(question);
      return std::optional<std::string>(answer);
    };
  };
  out_.str("");
  EXPECT_EQ(
      ExitCodeOf(RunGroupDelete(client_, {"depot"}, answering("yes"), Text())),
      1);
  ASSERT_TRUE(
      RunGroupDelete(client_, {"depot"}, answering("depot"), Text()).ok());
  EXPECT_EQ(out_.str(), "deleted groups/depot\n");
  EXPECT_THAT(questions[0],
              HasSubstr("Deletes groups/depot with the datums of its members, "
                        "and the loop closures and rejected candidates between "
                        "them, which cannot be undone. Type depot to go on: "));
  EXPECT_EQ(ExitCodeOf(
                RunGroupDelete(client_, {"depot"}, answering("depot"), Text())),
            69);
}

TEST_F(GroupCommandTest, MembersAreAddedWithAndWithoutADatum) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  ASSERT_TRUE(Line({"group", "add", "depot", "shuttle-7"}).ok());
  EXPECT_EQ(out_.str(), "added groups/depot/members/shuttle-7, revision 2\n");
  ASSERT_TRUE(
      Line({"group", "add", "groups/depot", "vehicles/shuttle-8", "--datum",
            "12.5,-3,1.5", "--datum-sigma", "5m,2deg", "--datum-id", "gate"},
           As(OutputFormat::kName))
          .ok());
  EXPECT_EQ(out_.str(), "groups/depot/members/shuttle-8\n");
  ASSERT_TRUE(Line({"group", "add", "depot", "drone", "--datum", "1,2,30,0.5",
                    "--datum-sigma", "3m,10deg"})
                  .ok());
  ASSERT_TRUE(Line({"group", "members", "depot"}).ok());
  EXPECT_THAT(out_.str(),
              ContainsRegex("VEHICLE +DATUM +X m +Y m +Z m +YAW rad\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("vehicles/shuttle-7 +- +- +- +- +-\n"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("vehicles/shuttle-8 +datum within 5 m and 2.0 "
                            "degrees, gate +12.50 +-3.00 +0.00 +1.5000\n"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("vehicles/drone +datum within 3 m and 10.0 degrees "
                            "+1.00 +2.00 +30.00 +0.5000\n"));
  ASSERT_TRUE(Line({"group", "members", "depot"}, Json()).ok());
  const json members = json::parse(out_.str())["members"];
  ASSERT_EQ(members.size(), 3u);
  EXPECT_EQ(members[0]["datum"]["covariance"]["form"],
            "COVARIANCE_FORM_SPATIAL_10");
  EXPECT_EQ(members[2]["datum"]["covariance"]["form"],
            "COVARIANCE_FORM_PLANAR_6");
  EXPECT_EQ(members[2]["datum"]["covariance"]["values"][0], 25.0);
}

TEST_F(GroupCommandTest, DatumNeedsItsSizeWithUnits) {
  const std::vector<const char*> begun = {"group", "add", "depot", "a"};
  const auto with = [&begun](const std::vector<const char*>& more) {
    std::vector<const char*> words = begun;
    words.insert(words.end(), more.begin(), more.end());
    return words;
  };
  for (const auto& words :
       {with({"--datum", "1,2,3"}), with({"--datum-sigma", "5m,2deg"}),
        with({"--datum-id", "gate"}),
        with({"--datum", "1,2,3", "--datum-sigma", "5,2"}),
        with({"--datum", "1,2,3", "--datum-sigma", "5m,2deg,x"}),
        with({"--datum", "1,2", "--datum-sigma", "5m,2deg"})}) {
    const absl::Status status = Line(words);
    EXPECT_EQ(ExitCodeOf(status), kExitUsage) << ErrorText(status);
  }
  EXPECT_THAT(
      ErrorText(Line(with({"--datum", "1,2,3", "--datum-sigma", "5,2"}))),
      HasSubstr("allowed is METERSm,DEGREESdeg, with the units, such as "
                "10m,1deg"));
}

TEST_F(GroupCommandTest, DatumIsReplacedAndRemovedButNotForgotten) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  ASSERT_TRUE(Line({"group", "add", "depot", "a"}).ok());
  ASSERT_TRUE(Line({"group", "set-datum", "depot", "a", "--datum", "1,2,3",
                    "--datum-sigma", "5m,2deg"})
                  .ok());
  EXPECT_EQ(out_.str(), "updated groups/depot/members/a, revision 3\n");
  EXPECT_EQ(ExitCodeOf(Line({"group", "set-datum", "depot", "a"})), kExitUsage);
  EXPECT_EQ(ExitCodeOf(Line({"group", "set-datum", "depot", "a", "--none",
                             "--datum", "1,2,3", "--datum-sigma", "5m,2deg"})),
            kExitUsage);
  const absl::Status late = Line({"group", "set-datum", "depot", "a", "--none",
                                  "--expected-revision", "2"});
  EXPECT_EQ(ExitCodeOf(late), 74);
  ASSERT_TRUE(Line({"group", "members", "depot"}).ok());
  EXPECT_THAT(out_.str(), HasSubstr("datum within 5 m"));
  ASSERT_TRUE(Line({"group", "set-datum", "depot", "a", "--none",
                    "--expected-revision", "3"})
                  .ok());
  ASSERT_TRUE(Line({"group", "members", "depot"}).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("vehicles/a +- +-"));
}

TEST_F(GroupCommandTest, MembersBesideDamagedOnesAreListed) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  for (const char* vehicle : {"a", "b", "c"}) {
    ASSERT_TRUE(Line({"group", "add", "depot", vehicle}).ok());
  }
  server_.FailUnaryCalls(
      {grpc::Status::OK, MakeStatus(grpc::StatusCode::DATA_LOSS, "a bad row",
                                    {"STORE_CORRUPT"})});
  EXPECT_EQ(ExitCodeOf(Line({"group", "members", "depot"})), 79);
  EXPECT_THAT(out_.str(), ContainsRegex("vehicles/a +-.*\nvehicles/b +-"));
}

TEST_F(GroupCommandTest, MemberIsRemovedByItsVehicle) {
  ASSERT_TRUE(Line({"group", "create", "depot"}).ok());
  ASSERT_TRUE(Line({"group", "add", "depot", "a"}).ok());
  ASSERT_TRUE(Line({"group", "remove", "depot", "vehicles/a"}, Json()).ok());
  EXPECT_EQ(json::parse(out_.str()),
            json({{"name", "groups/depot/members/a"}, {"revision", 3}}));
  ASSERT_TRUE(
      Line({"group", "members", "depot"}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(), "");
}

}  // namespace
}  // namespace revisit::client
