#include "client/revisit/pose_columns.h"

#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "gtest/gtest.h"
#include "tests/client/expanded_poses.h"
#include "tests/random.h"

namespace revisit::client {
namespace {

// How the poses of a batch are alike.
struct Alike {
  bool has_stamps = false;
  bool is_geodetic = false;
  bool has_heights = false;
  bool has_quaternions = false;
  bool is_diagonal = false;
  bool is_constant = false;
  v1::CovarianceForm form = v1::COVARIANCE_FORM_PLANAR_6;
  int transition = 0;
  bool begins = false;
};

Alike RandomAlike(std::mt19937_64& random) {
  const auto coin = [&] { return UniformInt(random, 0, 1) == 1; };
  return {coin(),
          coin(),
          coin(),
          coin(),
          coin(),
          coin(),
          static_cast<v1::CovarianceForm>(UniformInt(random, 1, 3)),
          coin() ? 0 : (coin() ? 9 : 16),
          coin()};
}

double RandomNumber(std::mt19937_64& random) {
  switch (UniformInt(random, 0, 9)) {
    case 0:
      return 0.0;
    case 1:
      return -0.0;
    default:
      return Uniform(random, -9.0, 9.0);
  }
}

void AddCovariance(const Alike& alike, std::mt19937_64& random,
                   v1::Covariance* covariance) {
  covariance->set_form(alike.form);
  const bool is_full = alike.form == v1::COVARIANCE_FORM_ROS_36;
  const int size = alike.form == v1::COVARIANCE_FORM_PLANAR_6 ? 3
                   : is_full                                  ? 6
                                                              : 4;
  for (int r = 0; r < size; ++r) {
    for (int c = is_full ? 0 : r; c < size; ++c) {
      covariance->add_values(
          r != c && alike.is_diagonal ? 0.0 : RandomNumber(random));
    }
  }
}

std::vector<v1::Pose> RandomPoses(const Alike& alike, int count,
                                  std::mt19937_64& random) {
  std::vector<v1::Pose> poses;
  v1::Covariance covariance;
  AddCovariance(alike, random, &covariance);
  for (int i = 0; i < count; ++i) {
    v1::Pose& pose = poses.emplace_back();
    pose.set_sequence(40 + static_cast<std::uint64_t>(i));
    if (alike.has_stamps) {
      // In any order, before the epoch too.
      pose.mutable_stamp()->set_seconds(UniformInt(random, -2, 2));
      pose.mutable_stamp()->set_nanos(UniformInt(random, 0, 999'999'999));
    }
    const double height = alike.has_heights ? RandomNumber(random) : 0.0;
    if (alike.is_geodetic) {
      pose.mutable_geodetic()->set_latitude_degrees(RandomNumber(random));
      pose.mutable_geodetic()->set_longitude_degrees(RandomNumber(random));
      pose.mutable_geodetic()->set_height_meters(height);
    } else {
      pose.mutable_local()->set_x_meters(RandomNumber(random));
      pose.mutable_local()->set_y_meters(RandomNumber(random));
      pose.mutable_local()->set_z_meters(height);
    }
    if (alike.has_quaternions) {
      pose.mutable_quaternion()->set_x(RandomNumber(random));
      pose.mutable_quaternion()->set_w(RandomNumber(random));
    } else {
      pose.set_heading_radians(RandomNumber(random));
    }
    if (!alike.is_constant) {
      covariance.Clear();
      AddCovariance(alike, random, &covariance);
    }
    *pose.mutable_covariance() = covariance;
    const bool is_first = i == 0 && alike.begins;
    if (is_first) pose.mutable_recording_start()->set_label("again");
    for (int k = 0; k < alike.transition && !is_first; ++k) {
      pose.add_error_transition(RandomNumber(random));
    }
  }
  return poses;
}

std::optional<v1::PoseColumns> ColumnsOf(const std::vector<v1::Pose>& poses) {
  std::vector<const v1::Pose*> pointers;
  for (const v1::Pose& pose : poses) pointers.push_back(&pose);
  return PoseColumnsOf(pointers);
}

TEST(PoseColumnsTest, SayWhatThePosesSayToTheBit) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 2000; ++trial) {
    const Alike alike = RandomAlike(random);
    const std::vector<v1::Pose> poses =
        RandomPoses(alike, UniformInt(random, 1, 5), random);
    v1::PoseBatch sent;
    const auto columns = ColumnsOf(poses);
    ASSERT_TRUE(columns.has_value());
    *sent.mutable_columns() = *columns;
    const v1::PoseBatch expanded = Expanded(sent);
    ASSERT_EQ(expanded.poses_size(), static_cast<int>(poses.size()));
    v1::PoseBatch read;
    ASSERT_TRUE(AddPosesOf(*columns, read.mutable_poses()).ok());
    ASSERT_EQ(read.poses_size(), static_cast<int>(poses.size()));
    for (std::size_t i = 0; i < poses.size(); ++i) {
      const int place = static_cast<int>(i);
      ASSERT_EQ(expanded.poses(place).SerializeAsString(),
                poses[i].SerializeAsString())
          << columns->DebugString();
      ASSERT_EQ(read.poses(place).SerializeAsString(),
                poses[i].SerializeAsString())
          << columns->DebugString();
    }
  }
}

TEST(PoseColumnsTest, ColumnsThatDoNotFitAreNoPoses) {
  std::mt19937_64 random = SeededRandom();
  Alike alike;
  alike.has_stamps = true;
  alike.has_heights = true;
  alike.transition = 9;
  const v1::PoseColumns fitting = *ColumnsOf(RandomPoses(alike, 4, random));
  const std::vector<std::function<void(v1::PoseColumns*)>> changes = {
      [](v1::PoseColumns* c) { c->set_pose_count(0); },
      [](v1::PoseColumns* c) { c->set_pose_count(-4); },
      [](v1::PoseColumns* c) {
        c->set_pose_count(std::numeric_limits<int>::max());
      },
      [](v1::PoseColumns* c) { c->clear_x_meters(); },
      [](v1::PoseColumns* c) { c->add_y_meters(1.0); },
      [](v1::PoseColumns* c) { c->add_z_meters(1.0); },
      [](v1::PoseColumns* c) { c->add_latitude_degrees(1.0); },
      [](v1::PoseColumns* c) { c->clear_heading_radians(); },
      [](v1::PoseColumns* c) { c->add_heading_radians(1.0); },
      [](v1::PoseColumns* c) { c->add_quaternions(1.0); },
      [](v1::PoseColumns* c) {
        c->clear_heading_radians();
        c->add_quaternions(1.0);
      },
      [](v1::PoseColumns* c) { c->clear_covariance_form(); },
      [](v1::PoseColumns* c) {
        c->set_covariance_form(static_cast<v1::CovarianceForm>(77));
      },
      [](v1::PoseColumns* c) { c->clear_covariances(); },
      [](v1::PoseColumns* c) { c->add_covariances(1.0); },
      [](v1::PoseColumns* c) { c->add_error_transitions(1.0); },
      [](v1::PoseColumns* c) { c->add_stamp_step_nanos(1); },
      [](v1::PoseColumns* c) { c->clear_first_stamp(); },
      [](v1::PoseColumns* c) { c->mutable_first_stamp()->set_nanos(-1); },
      [](v1::PoseColumns* c) {
        c->mutable_first_stamp()->set_seconds(1LL << 62);
      },
      [](v1::PoseColumns* c) {
        for (auto& step : *c->mutable_stamp_step_nanos()) step = 1LL << 62;
      },
  };
  for (std::size_t i = 0; i < changes.size(); ++i) {
    v1::PoseColumns columns = fitting;
    v1::PoseBatch read;
    EXPECT_TRUE(AddPosesOf(columns, read.mutable_poses()).ok());
    changes[i](&columns);
    EXPECT_EQ(AddPosesOf(columns, read.mutable_poses()).code(),
              absl::StatusCode::kInternal)
        << i;
    EXPECT_EQ(read.poses_size(), 4) << i;
  }
}

TEST(PoseColumnsTest, NumbersThatAllPosesHaveAreSentOnce) {
  std::mt19937_64 random = SeededRandom();
  Alike alike;
  alike.is_constant = true;
  EXPECT_EQ(ColumnsOf(RandomPoses(alike, 5, random))->covariances_size(), 6);
  alike.is_diagonal = true;
  const auto columns = ColumnsOf(RandomPoses(alike, 5, random));
  EXPECT_EQ(columns->covariances_size(), 0);
  EXPECT_EQ(columns->covariance_diagonals_size(), 3);
  EXPECT_EQ(columns->z_meters_size(), 0);
}

TEST(PoseColumnsTest, PosesThatAreNotAlikeHaveNoColumns) {
  std::mt19937_64 random = SeededRandom();
  Alike alike;
  alike.has_stamps = true;
  alike.transition = 9;
  const std::vector<std::function<void(v1::Pose*)>> changes = {
      [](v1::Pose* pose) { pose->clear_stamp(); },
      [](v1::Pose* pose) { pose->mutable_stamp()->set_nanos(-1); },
      [](v1::Pose* pose) { pose->mutable_stamp()->set_seconds(1LL << 60); },
      [](v1::Pose* pose) { pose->clear_position(); },
      [](v1::Pose* pose) { pose->mutable_geodetic(); },
      [](v1::Pose* pose) { pose->clear_orientation(); },
      [](v1::Pose* pose) { pose->mutable_quaternion(); },
      [](v1::Pose* pose) { pose->clear_covariance(); },
      [](v1::Pose* pose) { pose->mutable_covariance()->add_values(1.0); },
      [](v1::Pose* pose) {
        pose->mutable_covariance()->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
      },
      [](v1::Pose* pose) { pose->clear_error_transition(); },
      [](v1::Pose* pose) { pose->add_error_transition(1.0); },
      [](v1::Pose* pose) { pose->mutable_recording_start(); },
  };
  for (std::size_t i = 0; i < changes.size(); ++i) {
    std::vector<v1::Pose> poses = RandomPoses(alike, 4, random);
    EXPECT_TRUE(ColumnsOf(poses).has_value());
    changes[i](&poses[2]);
    EXPECT_FALSE(ColumnsOf(poses).has_value()) << i;
  }
}

}  // namespace
}  // namespace revisit::client
