#include "client/cli/commands/vehicle_command.h"

#include "client/cli/commands/info_command.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/cli/flags.h"
#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

class VehicleCommandTest : public CommandTest {
 protected:
  // Answers every question so.
  Ask Answering(std::optional<std::string> answer) {
    return [this, answer = std::move(answer)](const std::string& question) {
      questions_.push_back(question);
      return answer;
    };
  }

  std::vector<std::string> questions_;
};

TEST_F(VehicleCommandTest, ChecksAreStoredWhereAFlagSaysSo) {
  v1::VehicleSettings settings;
  CommandLine line({"bar", "", "", ""});
  AddVehicleSettings(line.program(), &settings);
  line.program().RunsAlone([](const Terminal&) { return absl::OkStatus(); });
  const char* words[] = {"bar", "--checks", "stored", "--keep-probability",
                         "0.2"};
  ASSERT_TRUE(line.Parse(5, words).ok());
  EXPECT_EQ(settings.checks(), v1::STORED_CHECKS_STORED);
  EXPECT_EQ(settings.keep_probability(), 0.2);
  EXPECT_THAT(UnusualSettings(settings),
              ElementsAre("checks=stored", "keep-probability=0.2"));
}

TEST_F(VehicleCommandTest, ChecksSearchInTheGroupThatAFlagNames) {
  v1::VehicleSettings settings;
  CommandLine line({"bar", "", "", ""});
  AddVehicleSettings(line.program(), &settings);
  line.program().RunsAlone([](const Terminal&) { return absl::OkStatus(); });
  const char* words[] = {"bar", "--check-group", "depot"};
  ASSERT_TRUE(line.Parse(3, words).ok());
  EXPECT_EQ(settings.check_group(), "groups/depot");
  EXPECT_THAT(UnusualSettings(settings), ElementsAre("check-group=depot"));
  const char* none[] = {"bar", "--check-group", ""};
  CommandLine again({"bar", "", "", ""});
  AddVehicleSettings(again.program(), &settings);
  again.program().RunsAlone([](const Terminal&) { return absl::OkStatus(); });
  ASSERT_TRUE(again.Parse(3, none).ok());
  // An update names it, so that the vehicle has none from then on.
  EXPECT_TRUE(settings.has_check_group());
  EXPECT_EQ(settings.check_group(), "");
  EXPECT_THAT(UnusualSettings(settings), IsEmpty());
}

TEST_F(VehicleCommandTest, SettingsThatAServerDoesNotTellAreNotUnusual) {
  EXPECT_THAT(UnusualSettings({}), IsEmpty());
  v1::VehicleSettings drive;
  SetUsualSettings(&drive);
  EXPECT_THAT(UnusualSettings(drive), IsEmpty());
  // Drives that are judged are asked check by check.
  EXPECT_EQ(drive.checks(), v1::STORED_CHECKS_UNSPECIFIED);
}

TEST_F(VehicleCommandTest, DeletionAsksForTheIdAndSaysWhatGoes) {
  Append(3);
  ASSERT_TRUE(RunVehicleDelete(client_, {"vehicles/shuttle"},
                               Answering("shuttle"), Json())
                  .ok());
  EXPECT_THAT(
      questions_,
      ElementsAre("Deletes vehicles/shuttle with its 3 poses and 0 loop "
                  "closures, which cannot be undone. Type shuttle to go on: "));
  EXPECT_THAT(server_.Deleted(), ElementsAre("vehicles/shuttle"));
  EXPECT_EQ(json::parse(out_.str()), json({{"deleted", {"vehicles/shuttle"}}}));
}

TEST_F(VehicleCommandTest, OtherAnswersDeleteNothing) {
  for (const auto& answer :
       {std::optional<std::string>("yes"), std::optional<std::string>("")}) {
    const absl::Status status =
        RunVehicleDelete(client_, {"shuttle"}, Answering(answer), Text());
    EXPECT_EQ(ExitCodeOf(status), 1);
    EXPECT_THAT(ErrorText(status),
                HasSubstr("vehicles/shuttle is not deleted: got \""));
  }
  EXPECT_FALSE(
      RunVehicleDelete(client_, {"shuttle"}, Answering(std::nullopt), Text())
          .ok());
  EXPECT_THAT(server_.Deleted(), IsEmpty());
}

TEST_F(VehicleCommandTest, VehicleThatThereIsNotIsToldBeforeTheQuestion) {
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::NOT_FOUND, "none")});
  EXPECT_EQ(ExitCodeOf(RunVehicleDelete(client_, {"shuttle"},
                                        Answering("shuttle"), Text())),
            69);
  EXPECT_THAT(questions_, IsEmpty());
}

TEST_F(VehicleCommandTest, InfoShowsTheServer) {
  ASSERT_TRUE(RunInfo(client_, "example:1", Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("server              example:1\n"
                                    "version             1.2.3\n"
                                    "durability          LOCAL (fsync=on)\n"));
  EXPECT_THAT(out_.str(), HasSubstr("vehicles in memory  0\n"));
  EXPECT_THAT(out_.str(), HasSubstr("shares the store    10.0.0.2:50051, "
                                    "vehicles owned: 12\n"));
  out_.str("");
  ASSERT_TRUE(RunInfo(client_, "example:1", Json()).ok());
  const json info = json::parse(out_.str());
  EXPECT_EQ(info["maxMessageBytes"], 4194304);
  EXPECT_EQ(info["durability"], "DURABILITY_LOCAL");
}

}  // namespace
}  // namespace revisit::client
