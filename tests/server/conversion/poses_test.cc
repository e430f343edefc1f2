#include "server/conversion/poses.h"

#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "core/geometry/heading.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Optional;
using ::testing::StartsWith;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

TEST(PoseConversionTest, TakesSequenceStampPositionAndHeadingAsTheyCame) {
  v1::Pose pose = PlanarPose(42, 1.5);
  pose.mutable_local()->set_y_meters(-2.5);
  pose.mutable_local()->set_z_meters(3.5);
  pose.mutable_stamp()->set_seconds(-2);
  pose.mutable_stamp()->set_nanos(5);
  const auto sample = DecodeOne(pose, Planar());
  ASSERT_THAT(sample, IsOk());
  EXPECT_EQ(sample->sequence, 42u);
  EXPECT_THAT(sample->stamp_ns, Optional(-1999999995));
  EXPECT_EQ(sample->pose.x, 1.5);
  EXPECT_EQ(sample->pose.y, -2.5);
  EXPECT_EQ(sample->pose.z, 3.5);
  EXPECT_EQ(sample->pose.heading, 0.5);
  EXPECT_FALSE(sample->transition.has_value());
}

TEST(PoseConversionTest, PutsPlanarNumbersWhereTheyBelong) {
  EXPECT_THAT(UpperOf(DecodeOne(PlanarPose(1, 0), Planar())),
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.06));
}

TEST(PoseConversionTest, PutsSpatialNumbersWhereTheyBelong) {
  v1::Pose pose = PlanarPose(1, 0);
  const std::vector<double> values = {4,   0.1, 0.7, 0.2, 5,
                                      0.8, 0.3, 6,   0.4, 0.9};
  SetCovariance(v1::COVARIANCE_FORM_SPATIAL_10, values, &pose);
  EXPECT_THAT(UpperOf(DecodeOne(pose, Spatial())),
              ::testing::ElementsAreArray(values));
  EXPECT_THAT(UpperOf(DecodeOne(pose, Planar())),
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.9));
}

TEST(PoseConversionTest, ReducesRosToPositionAndRotationAboutZ) {
  v1::Pose pose = PlanarPose(1, 0);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &pose);
  EXPECT_THAT(UpperOf(DecodeOne(pose, Spatial())),
              ElementsAre(10, 0.01, 0.02, 0.05, 11, 0.12, 0.15, 12, 0.25, 15));
  EXPECT_THAT(UpperOf(DecodeOne(pose, Planar())),
              ElementsAre(10, 0.01, 0, 0.05, 11, 0, 0.15, 0, 0, 15));
}

TEST(PoseConversionTest, LooksAtTheSymmetryOfTheReducedRosMatrixOnly) {
  v1::Pose pose = PlanarPose(1, 0);
  std::vector<double> values = RosMatrix();
  // The entry of x and rotation about x is not part of the state.
  values[6 * 0 + 3] += 1.0;
  // The entry of x and z is part of the state of a SPATIAL vehicle.
  values[6 * 0 + 2] += 1.0;
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, values, &pose);
  EXPECT_THAT(DecodeOne(pose, Planar()), IsOk());
  EXPECT_THAT(
      DecodeOne(pose, Spatial()),
      IsError(StatusCode::kInvalidArgument, "COVARIANCE_NOT_SYMMETRIC",
              StartsWith("poses[0].covariance.values: reduced to the state")));
}

TEST(PoseConversionTest, HeadingOfAQuaternionIsThatOfTheForwardAxis) {
  std::mt19937_64 random = SeededRandom();
  for (int i = 0; i < 200; ++i) {
    // The rotation is yaw, then pitch, then roll, about moving axes: the
    // forward axis then points to yaw, whatever pitch (below a quarter turn)
    // and roll.
    const double yaw = Uniform(random, -3.1, 3.1);
    const double pitch = Uniform(random, -1.5, 1.5);
    const double roll = Uniform(random, -3.1, 3.1);
    const double cy = std::cos(yaw / 2), sy = std::sin(yaw / 2);
    const double cp = std::cos(pitch / 2), sp = std::sin(pitch / 2);
    const double cr = std::cos(roll / 2), sr = std::sin(roll / 2);
    const double scale = Uniform(random, 0.9995, 1.0005) *
                         (UniformInt(random, 0, 1) == 0 ? 1 : -1);
    v1::Pose pose = PlanarPose(1, 0);
    pose.mutable_quaternion()->set_w(scale * (cr * cp * cy + sr * sp * sy));
    pose.mutable_quaternion()->set_x(scale * (sr * cp * cy - cr * sp * sy));
    pose.mutable_quaternion()->set_y(scale * (cr * sp * cy + sr * cp * sy));
    pose.mutable_quaternion()->set_z(scale * (cr * cp * sy - sr * sp * cy));
    const auto sample = DecodeOne(pose, Planar());
    ASSERT_THAT(sample, IsOk());
    EXPECT_NEAR(core::WrapHeading(sample->pose.heading - yaw), 0.0, 1e-12);
  }
}

TEST(PoseConversionTest, PutsTransitionsWhereTheyBelong) {
  v1::Pose planar = PlanarPose(2, 0);
  for (int i = 1; i <= 9; ++i) planar.add_error_transition(i);
  const auto nine = DecodeOne(planar, Filter(Planar()));
  ASSERT_THAT(nine, IsOk());
  ASSERT_TRUE(nine->transition.has_value());
  EXPECT_THAT(nine->transition->values,
              ElementsAre(1, 2, 0, 3, 4, 5, 0, 6, 0, 0, 1, 0, 7, 8, 0, 9));

  v1::Pose spatial = PlanarPose(2, 0);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &spatial);
  for (int i = 1; i <= 16; ++i) spatial.add_error_transition(i);
  const auto sixteen = DecodeOne(spatial, Filter(Spatial()));
  ASSERT_THAT(sixteen, IsOk());
  EXPECT_THAT(
      sixteen->transition->values,
      ElementsAre(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16));
}

TEST(PoseConversionTest, OnlyTheFirstPoseOfAFilterNeedsNoTransition) {
  EXPECT_THAT(DecodeOne(PlanarPose(1, 0), Filter(Planar())), IsOk());
  EXPECT_THAT(DecodeOne(PlanarPose(2, 0), Filter(Planar())),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("poses[0].error_transition: got 0 numbers")));
}

TEST(PoseConversionTest, NamesAllFaultsOfABatchUnderTheReasonOfTheFirst) {
  v1::Pose first = PlanarPose(5, 2e8);
  first.mutable_covariance()->set_values(2, kNan);
  v1::Pose second = PlanarPose(7, 0);
  second.clear_local();
  second.clear_orientation();
  second.clear_covariance();
  second.mutable_stamp()->set_seconds(9214646400);
  const auto batch = DecodeAll({first, second}, Planar());
  EXPECT_THAT(batch, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                             StartsWith("poses[0].local.x_meters: got 2")));
  EXPECT_THAT(
      FieldsOf(batch.status()),
      ElementsAre("poses[0].local.x_meters", "poses[0].covariance.values[2]",
                  "poses[1].stamp.seconds", "poses[1].position",
                  "poses[1].orientation", "poses[1].covariance",
                  "poses[1].sequence"));
}

TEST(PoseConversionTest, CountsFaultsThatNoAnswerCouldHold) {
  std::vector<v1::Pose> poses;
  for (int i = 1; i <= kMaxPoses; ++i) {
    poses.push_back(PlanarPose(static_cast<std::uint64_t>(i), kNan));
  }
  EXPECT_THAT(DecodeAll(poses, Planar()),
              IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                      HasSubstr("(and 99 more)")));
}

TEST(PoseConversionTest, RefusesTheWrongNumberOfPosesBeforeLookingAtThem) {
  EXPECT_THAT(DecodeAll({}, Planar()),
              IsError(StatusCode::kInvalidArgument, "BATCH_SIZE",
                      "poses: got 0 poses; allowed is [1, 100]"));
  EXPECT_THAT(DecodeAll(std::vector<v1::Pose>(kMaxPoses + 1), Planar()),
              IsError(StatusCode::kInvalidArgument, "BATCH_SIZE",
                      "poses: got 101 poses; allowed is [1, 100]"));
}

TEST(PoseConversionTest, NamesFieldsBelowThePathItIsGiven) {
  Poses poses;
  *poses.Add() = PlanarPose(0, 0);
  EXPECT_THAT(
      DecodeBatch({&poses, nullptr}, 1, Planar(), FieldPath().Field("batch")),
      IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
              StartsWith("batch.poses[0].sequence: got 0; allowed is [1, ")));
}

}  // namespace
}  // namespace revisit::server
