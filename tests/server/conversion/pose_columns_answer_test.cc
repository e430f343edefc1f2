// Poses that are answered as columns are those that are answered as messages.
#include "server/conversion/pose_columns_answer.h"

#include <cstdint>
#include <limits>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "google/protobuf/util/field_mask_util.h"
#include "gtest/gtest.h"
#include "server/conversion/poses.h"
#include "tests/client/expanded_poses.h"
#include "tests/random.h"
#include "tests/server/conversion/conversion_testing.h"

namespace revisit::server {
namespace {

using google::protobuf::FieldMask;
using google::protobuf::util::FieldMaskUtil;
using ::testing::ElementsAre;
using ::testing::UnorderedElementsAre;

double RandomNumber(std::mt19937_64& random) {
  switch (UniformInt(random, 0, 3)) {
    case 0:
      return 0.0;
    case 1:
      return -0.0;
    default:
      return Uniform(random, -9.0, 9.0);
  }
}

// A pose as one may be stored, with a sequence behind the last one.
v1::Pose RandomPose(std::uint64_t sequence, std::mt19937_64& random) {
  const auto one_in = [&](int n) { return UniformInt(random, 1, n) == 1; };
  v1::Pose pose;
  pose.set_sequence(sequence);
  if (!one_in(6)) {
    pose.mutable_stamp()->set_seconds(
        one_in(9) ? UniformInt(random, 0, 1) * 18'000'000'000 - 9'000'000'000
                  : UniformInt(random, -2, 2));
    pose.mutable_stamp()->set_nanos(UniformInt(random, 0, 999'999'999));
  }
  const double height = one_in(3) ? RandomNumber(random) : 0.0;
  if (one_in(9)) {
    pose.mutable_geodetic()->set_latitude_degrees(RandomNumber(random));
    pose.mutable_geodetic()->set_longitude_degrees(RandomNumber(random));
    pose.mutable_geodetic()->set_height_meters(height);
  } else {
    pose.mutable_local()->set_x_meters(RandomNumber(random));
    pose.mutable_local()->set_y_meters(RandomNumber(random));
    pose.mutable_local()->set_z_meters(height);
  }
  if (one_in(7)) {
    pose.mutable_quaternion()->set_z(RandomNumber(random));
    pose.mutable_quaternion()->set_w(1.0);
  } else {
    pose.set_heading_radians(RandomNumber(random));
  }
  const int form = one_in(7) ? UniformInt(random, 1, 3) : 1;
  const int order = form == 1 ? 3 : form == 2 ? 4 : 6;
  const bool is_diagonal = !one_in(4);
  pose.mutable_covariance()->set_form(static_cast<v1::CovarianceForm>(form));
  for (int r = 0; r < order; ++r) {
    for (int c = form == 3 ? 0 : r; c < order; ++c) {
      pose.mutable_covariance()->add_values(
          r == c || !is_diagonal ? RandomNumber(random) : 0.0);
    }
  }
  const int transition = one_in(9) ? 16 : one_in(3) ? 9 : 0;
  for (int k = 0; k < transition; ++k) {
    pose.add_error_transition(RandomNumber(random));
  }
  if (one_in(9)) pose.mutable_recording_start()->set_label("again");
  return pose;
}

FieldMask RandomMask(std::mt19937_64& random) {
  FieldMask mask;
  for (const char* const path :
       {"sequence", "stamp", "stamp.nanos", "local", "local.x_meters",
        "local.y_meters", "local.z_meters", "geodetic",
        "geodetic.longitude_degrees", "geodetic.height_meters",
        "heading_radians", "quaternion", "quaternion.w", "covariance",
        "covariance.form", "covariance.values", "error_transition",
        "recording_start", "recording_start.label"}) {
    if (UniformInt(random, 0, 3) == 0) mask.add_paths(path);
  }
  return mask;
}

// The poses of which the mask leaves these fields, as columns.
PoseColumnsAnswer::Messages AnswerOf(const std::vector<v1::Pose>& poses,
                                     const FieldMask& mask,
                                     int most_poses = kMaxPoses) {
  PoseColumnsAnswer::Messages messages;
  PoseColumnsAnswer answer(mask, most_poses, &messages);
  for (const v1::Pose& pose : poses) {
    v1::Pose left = pose;
    if (mask.paths_size() > 0) FieldMaskUtil::TrimMessage(mask, &left);
    answer.Add(left, pose.sequence());
  }
  answer.Finish();
  return messages;
}

std::vector<int> CountsOf(const PoseColumnsAnswer::Messages& messages) {
  std::vector<int> counts;
  for (const v1::PoseColumns& columns : messages) {
    counts.push_back(columns.pose_count());
  }
  return counts;
}

TEST(PoseColumnsAnswerTest, SaysWhatTheMessagesSayWhicheverFieldsAreLeft) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 3000; ++trial) {
    const FieldMask mask = trial % 2 == 0 ? FieldMask() : RandomMask(random);
    std::vector<v1::Pose> poses;
    std::uint64_t sequence = 40;
    for (int i = UniformInt(random, 1, 8); i > 0; --i) {
      sequence += UniformInt(random, 1, 9) == 1 ? 3 : 1;
      poses.push_back(RandomPose(sequence, random));
      // Neighbours are alike more often than not.
      if (poses.size() > 1 && UniformInt(random, 0, 3) > 0) {
        const std::uint64_t own = poses.back().sequence();
        poses.back() = poses[poses.size() - 2];
        poses.back().set_sequence(own);
        poses.back().clear_recording_start();
      }
    }
    const PoseColumnsAnswer::Messages messages = AnswerOf(poses, mask);
    Poses expanded;
    for (const v1::PoseColumns& columns : messages) {
      client::AddExpanded(columns, &expanded);
    }
    ASSERT_EQ(expanded.size(), static_cast<int>(poses.size()));
    for (std::size_t i = 0; i < poses.size(); ++i) {
      v1::Pose left = poses[i];
      if (mask.paths_size() > 0) FieldMaskUtil::TrimMessage(mask, &left);
      ASSERT_EQ(expanded[static_cast<int>(i)].SerializeAsString(),
                left.SerializeAsString())
          << FieldMaskUtil::ToString(mask) << "\n"
          << messages[0].DebugString() << left.DebugString();
    }
  }
}

TEST(PoseColumnsAnswerTest, PosesThatOneMessageCanHoldLieInOne) {
  std::vector<v1::Pose> poses;
  for (std::uint64_t sequence = 1; sequence <= 12; ++sequence) {
    poses.push_back(PlanarPose(sequence, 0.5));
  }
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(12));
  EXPECT_THAT(CountsOf(AnswerOf(poses, {}, 5)), ElementsAre(5, 5, 2));
  EXPECT_THAT(CountsOf(AnswerOf({}, {})), ElementsAre());
  poses[3].mutable_recording_start();
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(3, 9));
  // The first pose of a recording has no transition.
  for (std::size_t i = 4; i < 12; ++i) {
    for (int k = 0; k < 9; ++k) poses[i].add_error_transition(k);
  }
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(3, 9));
  poses[6].mutable_stamp()->set_seconds(1);
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(3, 3, 1, 5));
  poses.erase(poses.begin() + 10);
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(3, 3, 1, 3, 1));
}

TEST(PoseColumnsAnswerTest, StampsTooFarApartForAStepLieInTwoMessages) {
  std::vector<v1::Pose> poses = {PlanarPose(1, 0.0), PlanarPose(2, 0.0)};
  poses[0].mutable_stamp()->set_seconds(-9'000'000'000);
  poses[1].mutable_stamp()->set_seconds(9'000'000'000);
  EXPECT_THAT(CountsOf(AnswerOf(poses, {})), ElementsAre(1, 1));
}

TEST(PoseColumnsAnswerTest, ColumnsOfFieldsThatTheMaskLeavesOutAreEmpty) {
  const std::vector<v1::Pose> local = {PlanarPose(1, 0.5), PlanarPose(2, 1.5)};
  const std::vector<v1::Pose> geodetic = {GeodeticPose(1, 47.0, 8.0, 400.0),
                                          GeodeticPose(2, 47.1, 8.1, 0.0)};
  for (const auto& [path, column] :
       std::vector<std::pair<std::string, std::string>>{
           {"local.x_meters", "x_meters"},
           {"local.y_meters", "y_meters"},
           {"local.z_meters", "z_meters"},
           {"geodetic.latitude_degrees", "latitude_degrees"},
           {"geodetic.longitude_degrees", "longitude_degrees"},
           {"geodetic.height_meters", "height_meters"},
           {"heading_radians", "heading_radians"},
           {"sequence", "first_sequence"},
           {"covariance.form", "covariance_form"},
           {"covariance.values", "covariances"}}) {
    FieldMask mask;
    mask.add_paths(path);
    const v1::PoseColumns columns =
        AnswerOf(path[0] == 'g' ? geodetic : local, mask)[0];
    std::vector<const google::protobuf::FieldDescriptor*> fields;
    columns.GetReflection()->ListFields(columns, &fields);
    std::vector<std::string> filled;
    for (const auto* const field : fields) filled.push_back(field->name());
    EXPECT_THAT(filled, UnorderedElementsAre("pose_count", column));
  }
}

TEST(PoseColumnsAnswerTest, NumbersThatAllPosesHaveAreSaidOnce) {
  std::vector<v1::Pose> poses = {PlanarPose(1, 0.5), PlanarPose(2, 1.5)};
  for (v1::Pose& pose : poses) {
    SetCovariance(v1::COVARIANCE_FORM_PLANAR_6, {4, 1, 0, 5, 0, 6}, &pose);
  }
  EXPECT_THAT(AnswerOf(poses, {})[0].covariances(),
              ElementsAre(4, 1, 0, 5, 0, 6));
  for (v1::Pose& pose : poses) pose.mutable_covariance()->set_values(1, 0.0);
  EXPECT_THAT(AnswerOf(poses, {})[0].covariance_diagonals(),
              ElementsAre(4, 5, 6));
  EXPECT_THAT(AnswerOf(poses, {})[0].covariances(), ElementsAre());
  EXPECT_THAT(AnswerOf(poses, {})[0].z_meters(), ElementsAre());
  // Nobody could tell how many those of one pose are.
  FieldMask mask;
  mask.add_paths("covariance.values");
  EXPECT_EQ(AnswerOf(poses, mask)[0].covariances_size(), 12);
}

}  // namespace
}  // namespace revisit::server
