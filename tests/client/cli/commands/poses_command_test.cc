#include "client/cli/commands/poses_command.h"

#include <cmath>

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::ContainsRegex;
using ::testing::HasSubstr;
using ::testing::StartsWith;

class PosesCommandTest : public CommandTest {};

TEST_F(PosesCommandTest, AllPagesAreOneListInJson) {
  Append(2500);
  ASSERT_TRUE(RunPosesList(client_, {"shuttle"}, Json()).ok());
  const json poses = json::parse(out_.str())["poses"];
  ASSERT_EQ(poses.size(), 2500u);
  EXPECT_EQ(poses[2499]["sequence"], 2500);
  EXPECT_EQ(poses[2499]["local"]["xMeters"], 2500.0);
  EXPECT_EQ(server_.unary_calls(), 3);
}

TEST_F(PosesCommandTest, RangeHasBothItsEndsAndAsksForNoMore) {
  Append(2500);
  ASSERT_TRUE(RunPosesList(client_, {"shuttle", 999, 2001}, Json()).ok());
  const json poses = json::parse(out_.str())["poses"];
  ASSERT_EQ(poses.size(), 1003u);
  EXPECT_EQ(poses[0]["sequence"], 999);
  EXPECT_EQ(poses[1002]["sequence"], 2001);
  EXPECT_EQ(server_.unary_calls(), 2);
}

TEST_F(PosesCommandTest, VehicleWithoutPosesHasAnEmptyList) {
  ASSERT_TRUE(RunPosesList(client_, {"shuttle"}, Json()).ok());
  EXPECT_EQ(json::parse(out_.str()), json({{"poses", json::array()}}));
}

TEST_F(PosesCommandTest, TableHasItsTitlesOnce) {
  Append(1500);
  ASSERT_TRUE(RunPosesList(client_, {"shuttle"}, Text()).ok());
  EXPECT_THAT(out_.str(), StartsWith("SEQUENCE  STAMP "));
  EXPECT_EQ(out_.str().find("SEQUENCE", 1), std::string::npos);
  EXPECT_THAT(out_.str(), HasSubstr("\n    1500  -  "));
  EXPECT_THAT(out_.str(), HasSubstr(" 1500.000  "));
}

TEST_F(PosesCommandTest, YawOfAQuaternionIsANumber) {
  v1::PoseBatch batch;
  v1::Pose* const pose = batch.add_poses();
  pose->set_sequence(1);
  pose->mutable_local();
  // Two radians about z.
  pose->mutable_quaternion()->set_z(std::sin(1.0));
  pose->mutable_quaternion()->set_w(std::cos(1.0));
  server_.Replace("first", batch);
  ASSERT_TRUE(RunPosesList(client_, {"shuttle"}, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("  2.00000\n"));
}

TEST_F(PosesCommandTest, WideTableHasDeviationsAndQuaternions) {
  v1::PoseBatch batch;
  v1::Pose* const pose = batch.add_poses();
  pose->set_sequence(1);
  pose->mutable_local();
  pose->mutable_quaternion()->set_z(0.6);
  pose->mutable_quaternion()->set_w(0.8);
  pose->mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {0.25, 0.0, 0.0, 4.0, 0.0, 0.01}) {
    pose->mutable_covariance()->add_values(value);
  }
  v1::Pose* const plain = batch.add_poses();
  plain->set_sequence(2);
  plain->mutable_local();
  server_.Replace("first", batch);
  ASSERT_TRUE(RunPosesList(client_, {"shuttle"}, As(OutputFormat::kWide)).ok());
  EXPECT_THAT(out_.str(), HasSubstr("YAW rad     SD X m     SD Y m     SD Z m  "
                                    "SD YAW rad"));
  EXPECT_THAT(out_.str(), ContainsRegex(" 0.500 +2.000 +- +0.10000 +0.000000 "
                                        "+0.000000 +0.600000 +0.800000\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("\n +2 .* +0.00000( +-){8}\n"));
}

TEST_F(PosesCommandTest, ErrorBeforeTheFirstPosePrintsNothing) {
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::NOT_FOUND, "none")});
  EXPECT_EQ(ExitCodeOf(RunPosesList(client_, {"shuttle"}, Json())), 69);
  EXPECT_EQ(out_.str(), "");
}

}  // namespace
}  // namespace revisit::client
