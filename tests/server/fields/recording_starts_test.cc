#include "server/fields/recording_starts.h"

#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/records/proto_record_codec.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

v1::Pose PoseWith(const v1::RecordingStart& start) {
  v1::Pose pose = PlanarPose(2, 1.0);
  *pose.mutable_recording_start() = start;
  return pose;
}

v1::Pose PoseWith(const std::string& start) {
  return PoseWith(FromText<v1::RecordingStart>(start));
}

// With a covariance that any state space takes.
v1::Pose SpatialPoseWith(const std::string& start) {
  v1::Pose pose = PoseWith(start);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &pose);
  return pose;
}

// The start that a pose of a vehicle brings; null, and a failure, if it is
// refused.
std::shared_ptr<const core::RecordingStart> StartOf(
    const v1::Pose& pose, const VehicleConfig& config) {
  const auto sample = DecodeOne(pose, config);
  EXPECT_THAT(sample, IsOk());
  return sample.ok() ? sample->recording_start : nullptr;
}

v1::RecordingStart After(v1::CovarianceForm form,
                         const std::vector<double>& values) {
  v1::RecordingStart start;
  start.mutable_after()->set_form(form);
  start.mutable_after()->mutable_values()->Assign(values.begin(), values.end());
  return start;
}

TEST(RecordingStartTest, MostPosesBeginNone) {
  EXPECT_EQ(StartOf(PlanarPose(2, 1.0), Planar()), nullptr);
}

TEST(RecordingStartTest, OneThatSaysNothingBeginsAfterTheUsualGap) {
  const auto start = StartOf(PoseWith(""), Planar());
  ASSERT_NE(start, nullptr);
  EXPECT_EQ(start->relation, core::RecordingRelation::kAfter);
  EXPECT_EQ(start->covariance.upper, core::UsualGap().upper);
  EXPECT_EQ(start->label, "");
}

TEST(RecordingStartTest, GapMayHaveEveryFormOfAPosesCovariance) {
  const auto planar = StartOf(PoseWith(After(v1::COVARIANCE_FORM_PLANAR_6,
                                             {4, 0.1, 0.2, 5, 0.3, 0.06})),
                              Planar());
  ASSERT_NE(planar, nullptr);
  EXPECT_EQ(planar->relation, core::RecordingRelation::kAfter);
  EXPECT_THAT(planar->covariance.upper,
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.06));
  const std::vector<double> ten = {4, 0.1, 0.7, 0.2, 5, 0.8, 0.3, 6, 0.4, 0.9};
  const auto spatial =
      StartOf(PoseWith(After(v1::COVARIANCE_FORM_SPATIAL_10, ten)), Planar());
  ASSERT_NE(spatial, nullptr);
  EXPECT_THAT(spatial->covariance.upper,
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.9));
  const auto ros = StartOf(
      PoseWith(After(v1::COVARIANCE_FORM_ROS_36, RosMatrix())), Planar());
  ASSERT_NE(ros, nullptr);
  EXPECT_THAT(ros->covariance.upper,
              ElementsAre(10, 0.01, 0, 0.05, 11, 0, 0.15, 0, 0, 15));
}

TEST(RecordingStartTest, DatumIsTakenAsItIs) {
  const auto start = StartOf(
      PoseWith(R"pb(
        label: "tuesday.csv"
        datum {
          datum_id: "site"
          pose { x_meters: 10 y_meters: -20 z_meters: 3 heading_radians: 0.5 }
          covariance {
            form: COVARIANCE_FORM_PLANAR_6
            values: [ 1, 0, 0, 1, 0, 0.01 ]
          }
        }
      )pb"),
      Planar());
  ASSERT_NE(start, nullptr);
  core::RecordingStart expected;
  expected.relation = core::RecordingRelation::kDatum;
  expected.label = "tuesday.csv";
  expected.datum_id = "site";
  expected.datum = {10, -20, 3, 0.5};
  expected.covariance(0, 0) = expected.covariance(1, 1) = 1.0;
  expected.covariance(3, 3) = 0.01;
  EXPECT_TRUE(*start == expected);
}

TEST(RecordingStartTest, DatumWithoutAPoseIsTheSharedFrame) {
  const auto start = StartOf(SpatialPoseWith(R"pb(
                               datum {
                                 covariance {
                                   form: COVARIANCE_FORM_SPATIAL_10
                                   values: [ 1, 0, 0, 0, 1, 0, 0, 2, 0, 0.01 ]
                                 }
                               }
                             )pb"),
                             Spatial());
  ASSERT_NE(start, nullptr);
  EXPECT_EQ(start->datum.x, 0.0);
  EXPECT_EQ(start->datum.heading, 0.0);
  EXPECT_EQ(start->covariance(2, 2), 2.0);
  EXPECT_EQ(start->datum_id, "");
}

TEST(RecordingStartTest, UnknownNeedsNothingElse) {
  const auto start = StartOf(PoseWith("unknown: true label: 'x'"), Planar());
  ASSERT_NE(start, nullptr);
  EXPECT_EQ(start->relation, core::RecordingRelation::kUnknown);
  EXPECT_EQ(start->label, "x");
}

constexpr char kGoodDatum[] =
    "covariance { form: COVARIANCE_FORM_SPATIAL_10"
    " values: [1, 0, 0, 0, 1, 0, 0, 1, 0, 0.01] }";

TEST(RecordingStartTest, NamesTheFieldThatIsWrong) {
  const std::string id(129, 'd');
  const struct {
    std::string start;
    const char* reason;
    const char* field;
    const char* says;
    VehicleConfig config = Planar();
  } cases[] = {
      {absl::StrCat("label: '", std::string(257, 'x'), "'"), "INVALID_FIELD",
       "label", "got 257 bytes; allowed are 256"},
      {"label: 'a\\nb'", "INVALID_FIELD", "label", "U+000A"},
      {"unknown: false", "INVALID_FIELD", "unknown",
       "got false; allowed is true"},
      {"after {}", "INVALID_FIELD", "after.form",
       "required is PLANAR_6, SPATIAL_10 or ROS_36"},
      {"after { form: COVARIANCE_FORM_PLANAR_6 values: 1 }", "COVARIANCE_SIZE",
       "after.values", "got 1 numbers; PLANAR_6 has 6"},
      {"after { form: COVARIANCE_FORM_PLANAR_6 values: [1, 0, 0, 1, 0, nan] }",
       "NOT_FINITE", "after.values[5]", "allowed are finite numbers"},
      {"after { form: COVARIANCE_FORM_PLANAR_6 values: [1, 0, 0, 1, 0, 0] }",
       "COVARIANCE_NOT_POSITIVE_DEFINITE", "after.values",
       "the variance of heading is 0"},
      {"after { form: COVARIANCE_FORM_PLANAR_6 values: [1, 0, 0, 1e19, 0, 1] }",
       "INVALID_FIELD", "after.values", "allowed is at most 1e+09"},
      {"after { form: COVARIANCE_FORM_PLANAR_6 values: [1, 0, 0, 1, 0, 1] }",
       "INVALID_FIELD", "after.form", "SPATIAL", Spatial()},
      {"datum {}", "INVALID_FIELD", "datum.covariance", "required"},
      {absl::StrCat("datum { datum_id: '", id, "' ", kGoodDatum, "}"),
       "INVALID_FIELD", "datum.datum_id", "got 129 bytes; allowed are 128"},
      {"datum { datum_id: '\\001' covariance { form: COVARIANCE_FORM_PLANAR_6"
       " values: [1, 0, 0, 1, 0, 0.01] } }",
       "INVALID_FIELD", "datum.datum_id", "U+0001"},
      {"datum { covariance { form: COVARIANCE_FORM_ROS_36 } }", "INVALID_FIELD",
       "datum.covariance.form", "required is PLANAR_6 or SPATIAL_10"},
      {"datum { covariance { form: COVARIANCE_FORM_PLANAR_6"
       " values: [1, 0, 0, 1, 0, 0.01] } }",
       "INVALID_FIELD", "datum.covariance.form", "required is SPATIAL_10",
       Spatial()},
      {"datum { covariance { form: COVARIANCE_FORM_PLANAR_6"
       " values: [1, 2, 0, 1, 0, 0.01] } }",
       "COVARIANCE_NOT_POSITIVE_DEFINITE", "datum.covariance.values",
       "not positive definite"},
      {absl::StrCat("datum { pose { x_meters: 1.001e8 } ", kGoodDatum, "}"),
       "INVALID_FIELD", "datum.pose.x_meters",
       "allowed is [-100000000, 100000000]"},
      {absl::StrCat("datum { pose { y_meters: inf } ", kGoodDatum, "}"),
       "NOT_FINITE", "datum.pose.y_meters", "allowed are finite numbers"},
      {absl::StrCat("datum { pose { z_meters: nan } ", kGoodDatum, "}"),
       "NOT_FINITE", "datum.pose.z_meters", "allowed are finite numbers"},
      {absl::StrCat("datum { pose { heading_radians: -1.001e6 } ", kGoodDatum,
                    "}"),
       "INVALID_FIELD", "datum.pose.heading_radians",
       "allowed is [-1000000, 1000000]"},
  };
  for (const auto& one : cases) {
    const std::string field =
        absl::StrCat("poses[0].recording_start.", one.field);
    const auto sample = DecodeOne(SpatialPoseWith(one.start), one.config);
    EXPECT_THAT(sample, IsError(StatusCode::kInvalidArgument, one.reason,
                                HasSubstr(one.says)))
        << one.start;
    EXPECT_THAT(FieldsOf(sample.status()), ElementsAre(field)) << one.start;
  }
}

TEST(RecordingStartTest, AllThatIsWrongIsNamedAtOnce) {
  v1::Pose pose = PoseWith("label: '\\001' datum { pose { x_meters: nan } }");
  pose.mutable_local()->set_x_meters(kNan);
  EXPECT_THAT(
      FieldsOf(DecodeOne(pose, Planar()).status()),
      ElementsAre("poses[0].local.x_meters", "poses[0].recording_start.label",
                  "poses[0].recording_start.datum.pose.x_meters",
                  "poses[0].recording_start.datum.covariance"));
}

TEST(RecordingStartTest, GeodeticVehiclesHaveOneFrame) {
  v1::Pose pose = GeodeticPose(1, 43.8, -79.5, 150.0);
  *pose.mutable_recording_start() = v1::RecordingStart();
  EXPECT_THAT(DecodeOne(pose, Geodetic(Planar())),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      HasSubstr("poses[0].recording_start: got one; this "
                                "vehicle's coordinate frame is GEODETIC")));
}

TEST(RecordingStartTest, AFilterThatBeginsAnewHasNoTransitionToTell) {
  VehicleConfig config = Planar();
  config.drive.search.correlation_model = core::CorrelationModel::kFilter;
  EXPECT_NE(StartOf(PoseWith(""), config), nullptr);
  EXPECT_THAT(DecodeOne(PlanarPose(2, 1.0), config),
              IsError(StatusCode::kInvalidArgument, _,
                      HasSubstr("poses[0].error_transition")));
}

TEST(RecordingStartTest, RevisionsLeaveItAlone) {
  EXPECT_THAT(
      CheckRevisedPoses(PosesOf({PoseWith("unknown: false")}), 0, Planar()),
      IsOk());
}

// A later server may forbid what an earlier one has stored.
TEST(RecordingStartTest, TextsThatAreStoredAreNotJudgedAgain) {
  v1::PoseBatch batch;
  *batch.add_poses() = PoseWith("label: 'a\\nb'");
  const auto stored =
      ProtoRecordCodec().DecodePoses(batch.SerializeAsString(), Planar());
  ASSERT_THAT(stored, IsOk());
  EXPECT_EQ(stored->samples[0].recording_start->label, "a\nb");
}

TEST(RecordingStartTest, WhatIsStoredIsJudgedOtherwise) {
  v1::PoseBatch batch;
  *batch.add_poses() = PoseWith("datum {}");
  EXPECT_THAT(
      ProtoRecordCodec().DecodePoses(batch.SerializeAsString(), Planar()),
      IsError(StatusCode::kDataLoss, _, HasSubstr("does not decode")));
}

}  // namespace
}  // namespace revisit::server
