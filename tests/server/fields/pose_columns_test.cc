// Poses as columns are the poses that messages are, or refused by the place of
// what is wrong.
#include "server/fields/pose_columns.h"

#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "gmock/gmock.h"
#include "google/protobuf/repeated_field.h"
#include "gtest/gtest.h"
#include "server/conversion/poses.h"
#include "server/fields/pose_fields.h"
#include "server/records/proto_record_codec.h"
#include "tests/random.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::ElementsAreArray;
using ::testing::HasSubstr;

constexpr double kNoNumber = std::numeric_limits<double>::quiet_NaN();

absl::StatusOr<DecodedBatch> DecodeColumns(const v1::PoseColumns& columns,
                                           const VehicleConfig& config) {
  const Poses none;
  return DecodeBatch({&none, &columns}, kMaxPoses, config,
                     FieldPath().Field("batch"));
}

// `count` planar poses a metre apart.
v1::PoseColumns SomeColumns(int count) {
  v1::PoseColumns columns;
  columns.set_first_sequence(7);
  columns.set_pose_count(count);
  for (int i = 0; i < count; ++i) {
    columns.add_x_meters(i);
    columns.add_y_meters(-2.0 * i);
    columns.add_heading_radians(0.25);
  }
  columns.set_covariance_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double variance : {4.0, 5.0, 0.06}) {
    columns.add_covariance_diagonals(variance);
  }
  return columns;
}

// The values of a positive definite covariance whose other entries are small or
// 0.
std::vector<double> RandomCovariance(v1::CovarianceForm form, bool is_diagonal,
                                     std::mt19937_64& random) {
  const int size = form == v1::COVARIANCE_FORM_PLANAR_6     ? 3
                   : form == v1::COVARIANCE_FORM_SPATIAL_10 ? 4
                                                            : 6;
  std::vector<std::vector<double>> matrix(
      static_cast<std::size_t>(size),
      std::vector<double>(static_cast<std::size_t>(size)));
  for (std::size_t r = 0; r < matrix.size(); ++r) {
    matrix[r][r] = Uniform(random, 1.0, 2.0);
    for (std::size_t c = r + 1; c < matrix.size(); ++c) {
      matrix[r][c] = matrix[c][r] =
          is_diagonal ? 0.0 : Uniform(random, -0.1, 0.1);
    }
  }
  std::vector<double> values;
  for (std::size_t r = 0; r < matrix.size(); ++r) {
    const std::size_t first = form == v1::COVARIANCE_FORM_ROS_36 ? 0 : r;
    values.insert(values.end(),
                  matrix[r].begin() + static_cast<std::ptrdiff_t>(first),
                  matrix[r].end());
  }
  return values;
}

// The same poses in both forms, of a vehicle with this config.
struct Both {
  VehicleConfig config;
  std::vector<v1::Pose> poses;
  v1::PoseColumns columns;
};

Both RandomPoses(std::mt19937_64& random) {
  const auto coin = [&] { return UniformInt(random, 0, 1) == 1; };
  Both both;
  const bool is_spatial = coin();
  const bool is_filter = coin();
  const bool is_geodetic = coin();
  both.config = is_spatial ? Spatial() : Planar();
  if (is_filter) both.config = Filter(both.config);
  if (is_geodetic) both.config = Geodetic(both.config);
  const int count = UniformInt(random, 1, 5);
  const bool has_stamps = coin();
  const bool has_heights = coin();
  const bool has_quaternions = coin();
  const bool is_diagonal = coin();
  const bool is_constant = coin();
  const bool begins = !is_geodetic && coin();
  v1::CovarianceForm form = v1::COVARIANCE_FORM_ROS_36;
  if (coin()) {
    form = is_spatial ? v1::COVARIANCE_FORM_SPATIAL_10
                      : v1::COVARIANCE_FORM_PLANAR_6;
  }
  const auto first =
      static_cast<std::uint64_t>(begins ? UniformInt(random, 1, 9) : 2);
  v1::PoseColumns& columns = both.columns;
  columns.set_first_sequence(first);
  columns.set_pose_count(count);
  columns.set_covariance_form(form);
  std::vector<double> covariance;
  // Before the epoch too, where nanoseconds count up and seconds down.
  std::int64_t seconds = UniformInt(random, -2, 2);
  std::int64_t nanos = 999'000'000;
  for (int i = 0; i < count; ++i) {
    v1::Pose& pose = both.poses.emplace_back();
    pose.set_sequence(first + static_cast<std::uint64_t>(i));
    if (has_stamps) {
      if (i > 0) {
        const std::int64_t step = UniformInt(random, -900'000'000, 900'000'000);
        columns.add_stamp_step_nanos(step);
        nanos += step;
        while (nanos < 0) nanos += 1'000'000'000, --seconds;
        while (nanos >= 1'000'000'000) nanos -= 1'000'000'000, ++seconds;
      }
      pose.mutable_stamp()->set_seconds(seconds);
      pose.mutable_stamp()->set_nanos(static_cast<std::int32_t>(nanos));
      if (i == 0) *columns.mutable_first_stamp() = pose.stamp();
    }
    const double a = Uniform(random, -1.0, 1.0);
    const double b = coin() ? -0.0 : Uniform(random, -1.0, 1.0);
    const double c = has_heights ? Uniform(random, 0.0, 9.0) : 0.0;
    if (is_geodetic) {
      pose.mutable_geodetic()->set_latitude_degrees(a);
      pose.mutable_geodetic()->set_longitude_degrees(b);
      pose.mutable_geodetic()->set_height_meters(c);
      columns.add_latitude_degrees(a);
      columns.add_longitude_degrees(b);
      if (has_heights) columns.add_height_meters(c);
    } else {
      pose.mutable_local()->set_x_meters(a);
      pose.mutable_local()->set_y_meters(b);
      pose.mutable_local()->set_z_meters(c);
      columns.add_x_meters(a);
      columns.add_y_meters(b);
      if (has_heights) columns.add_z_meters(c);
    }
    const double heading = Uniform(random, -9.0, 9.0);
    if (has_quaternions) {
      pose.mutable_quaternion()->set_z(std::sin(heading / 2));
      pose.mutable_quaternion()->set_w(std::cos(heading / 2));
      for (const double part :
           {0.0, 0.0, pose.quaternion().z(), pose.quaternion().w()}) {
        columns.add_quaternions(part);
      }
    } else {
      pose.set_heading_radians(heading);
      columns.add_heading_radians(heading);
    }
    if (i == 0 || !is_constant) {
      covariance = RandomCovariance(form, is_diagonal, random);
      for (std::size_t k = 0; k < covariance.size(); ++k) {
        if (!is_diagonal) {
          columns.add_covariances(covariance[k]);
        } else if (covariance[k] != 0.0) {
          columns.add_covariance_diagonals(covariance[k]);
        }
      }
    }
    SetCovariance(form, covariance, &pose);
    if (i == 0 && begins) {
      pose.mutable_recording_start()->set_label("again");
      *columns.mutable_recording_start() = pose.recording_start();
    }
    if (is_filter && (i > 0 || !begins)) {
      for (int k = 0; k < (is_spatial ? 16 : 9); ++k) {
        const double entry = Uniform(random, -1.0, 1.0);
        pose.add_error_transition(entry);
        columns.add_error_transitions(entry);
      }
    }
  }
  return both;
}

void ExpectSameBits(const core::PoseSample& a, const core::PoseSample& b) {
  const auto is_same = [](const auto& one, const auto& other) {
    return std::memcmp(&one, &other, sizeof(one)) == 0;
  };
  EXPECT_EQ(a.sequence, b.sequence);
  EXPECT_EQ(a.stamp_ns, b.stamp_ns);
  EXPECT_TRUE(is_same(a.pose, b.pose)) << a.pose.x << " " << b.pose.x;
  EXPECT_TRUE(is_same(a.covariance, b.covariance));
  ASSERT_EQ(a.transition.has_value(), b.transition.has_value());
  EXPECT_TRUE(!a.transition || is_same(*a.transition, *b.transition));
  EXPECT_EQ(a.recording_start != nullptr, b.recording_start != nullptr);
}

TEST(PoseColumnsTest, AreStoredAsTheMessagesThatSayTheSame) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 2000; ++trial) {
    const Both both = RandomPoses(random);
    const auto poses = DecodeAll(both.poses, both.config);
    ASSERT_THAT(poses, IsOk());
    // It reads what comes over the wire.
    v1::PoseColumns sent;
    ASSERT_TRUE(sent.ParseFromString(both.columns.SerializeAsString()));
    const auto columns = DecodeColumns(sent, both.config);
    ASSERT_THAT(columns, IsOk()) << sent.DebugString();
    const auto messages = ProtoRecordCodec().AsMessages(columns->payload);
    ASSERT_THAT(messages, IsOk());
    EXPECT_EQ(*messages, poses->payload) << sent.DebugString();
    ASSERT_EQ(columns->samples.size(), poses->samples.size());
    for (std::size_t i = 0; i < poses->samples.size(); ++i) {
      ExpectSameBits(columns->samples[i], poses->samples[i]);
    }
    EXPECT_EQ(columns->origin.has_value(), poses->origin.has_value());
  }
}

// The poses of columns, one by one.
std::vector<v1::Pose> MessagesOf(const v1::PoseColumns& message) {
  Violations violations;
  PoseColumns columns(ColumnFieldsOf(message), FieldPath(), &violations);
  EXPECT_EQ(violations.count(), 0u);
  std::vector<v1::Pose> poses(columns.size());
  for (std::size_t i = 0; i < poses.size(); ++i) {
    SetPose(columns.At(i), &poses[i]);
  }
  return poses;
}

TEST(PoseColumnsTest, AreRefusedWhereverTheMessagesThatSayTheSameAre) {
  std::mt19937_64 random = SeededRandom();
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  const std::vector<double> numbers = {
      kNoNumber, kInfinity, -1.0, 0.0, 1e-300, 1.001, 1e7, 1e10, 1e300, -1e9};
  int refused = 0;
  for (int trial = 0; trial < 5000; ++trial) {
    Both both = RandomPoses(random);
    v1::PoseColumns& columns = both.columns;
    std::vector<google::protobuf::RepeatedField<double>*> all;
    for (auto* column :
         {columns.mutable_x_meters(), columns.mutable_y_meters(),
          columns.mutable_z_meters(), columns.mutable_heading_radians(),
          columns.mutable_quaternions(), columns.mutable_covariances(),
          columns.mutable_covariance_diagonals(),
          columns.mutable_error_transitions()}) {
      if (!column->empty()) all.push_back(column);
    }
    auto* const column = all[static_cast<std::size_t>(
        UniformInt(random, 0, static_cast<int>(all.size()) - 1))];
    column->Set(UniformInt(random, 0, column->size() - 1),
                numbers[static_cast<std::size_t>(UniformInt(
                    random, 0, static_cast<int>(numbers.size()) - 1))]);
    if (UniformInt(random, 0, 9) == 0) {
      columns.set_first_sequence(
          (std::uint64_t{1} << 63) -
          static_cast<std::uint64_t>(UniformInt(random, 1, 6)));
    }
    const auto poses = DecodeAll(MessagesOf(columns), both.config);
    const auto decoded = DecodeColumns(columns, both.config);
    ASSERT_EQ(decoded.ok(), poses.ok()) << columns.DebugString();
    if (!poses.ok()) {
      ++refused;
      continue;
    }
    for (std::size_t i = 0; i < poses->samples.size(); ++i) {
      ExpectSameBits(decoded->samples[i], poses->samples[i]);
    }
  }
  EXPECT_GT(refused, 1000);
}

// Changes good columns, and expects all to be refused for these fields.
void ExpectRefused(const std::function<void(v1::PoseColumns*)>& change,
                   const std::string& reason,
                   const std::vector<std::string>& fields,
                   const VehicleConfig& config = Planar()) {
  v1::PoseColumns columns = SomeColumns(3);
  change(&columns);
  const absl::Status status = DecodeColumns(columns, config).status();
  EXPECT_THAT(status, IsError(StatusCode::kInvalidArgument, reason, _));
  std::vector<std::string> named;
  for (const std::string& field : fields) {
    named.push_back(absl::StrCat("batch.columns.", field));
  }
  EXPECT_THAT(FieldsOf(status), ElementsAreArray(named));
}

TEST(PoseColumnsTest, AnyNumberOfPosesButThoseOfABatchIsRefused) {
  for (const int count : {0, -1, kMaxPoses + 1}) {
    ExpectRefused([&](v1::PoseColumns* c) { c->set_pose_count(count); },
                  "BATCH_SIZE", {"pose_count"});
  }
}

TEST(PoseColumnsTest, CountForNoMoreThanWasSent) {
  const Poses none;
  v1::PoseColumns columns = SomeColumns(3);
  EXPECT_EQ((SentPoses{&none, &columns}.count()), 3u);
  columns.set_pose_count(std::numeric_limits<int>::max());
  EXPECT_EQ((SentPoses{&none, &columns}.count()), 3u);
  columns.set_pose_count(-1);
  EXPECT_EQ((SentPoses{&none, &columns}.count()), 0u);
}

TEST(PoseColumnsTest, ColumnsThatAreTooLongOrTooShortAreNamed) {
  ExpectRefused([](v1::PoseColumns* c) { c->add_x_meters(1.0); }, "COLUMN_SIZE",
                {"x_meters"});
  ExpectRefused([](v1::PoseColumns* c) { c->clear_y_meters(); }, "COLUMN_SIZE",
                {"y_meters"});
  ExpectRefused([](v1::PoseColumns* c) { c->add_z_meters(1.0); }, "COLUMN_SIZE",
                {"z_meters"});
  ExpectRefused([](v1::PoseColumns* c) { c->add_heading_radians(1.0); },
                "COLUMN_SIZE", {"heading_radians"});
  ExpectRefused([](v1::PoseColumns* c) { c->add_covariance_diagonals(1.0); },
                "COLUMN_SIZE", {"covariance_diagonals"});
  ExpectRefused([](v1::PoseColumns* c) { c->add_error_transitions(1.0); },
                "COLUMN_SIZE", {"error_transitions"});
  ExpectRefused([](v1::PoseColumns* c) { c->add_stamp_step_nanos(1); },
                "COLUMN_SIZE", {"stamp_step_nanos"});
  ExpectRefused(
      [](v1::PoseColumns* c) { c->mutable_first_stamp()->set_seconds(1); },
      "COLUMN_SIZE", {"stamp_step_nanos"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->clear_heading_radians();
        c->add_quaternions(1.0);
      },
      "COLUMN_SIZE", {"quaternions"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->clear_x_meters();
        c->clear_y_meters();
        c->add_longitude_degrees(1.0);
      },
      "INVALID_FIELD", {"x_meters", "latitude_degrees", "longitude_degrees"});
}

TEST(PoseColumnsTest, OfTwoColumnsThatSayTheSameOneIsRequired) {
  ExpectRefused([](v1::PoseColumns* c) { c->clear_heading_radians(); },
                "INVALID_FIELD", {"heading_radians"});
  ExpectRefused([](v1::PoseColumns* c) { c->clear_covariance_diagonals(); },
                "INVALID_FIELD", {"covariances"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        for (int i = 0; i < 12; ++i) c->add_quaternions(0.5);
      },
      "INVALID_FIELD", {"heading_radians"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        for (int i = 0; i < 6; ++i) c->add_covariances(1.0);
      },
      "INVALID_FIELD", {"covariances"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        for (int i = 0; i < 3; ++i) c->add_latitude_degrees(1.0);
        for (int i = 0; i < 3; ++i) c->add_longitude_degrees(1.0);
      },
      "INVALID_FIELD", {"x_meters"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->set_covariance_form(v1::COVARIANCE_FORM_UNSPECIFIED);
      },
      "INVALID_FIELD", {"covariance_form"});
  v1::PoseColumns columns = SomeColumns(3);
  const Poses poses = PosesOf({PlanarPose(1, 0.0)});
  EXPECT_THAT(
      FieldsOf(DecodeBatch({&poses, &columns}, kMaxPoses, Planar(), FieldPath())
                   .status()),
      ElementsAre("columns"));
}

TEST(PoseColumnsTest, AWrongNumberIsNamedByItsPlaceInItsColumn) {
  ExpectRefused([](v1::PoseColumns* c) { c->set_x_meters(1, kNoNumber); },
                "NOT_FINITE", {"x_meters[1]"});
  ExpectRefused([](v1::PoseColumns* c) { c->set_heading_radians(2, 1e9); },
                "INVALID_FIELD", {"heading_radians[2]"});
  ExpectRefused([](v1::PoseColumns* c) { c->set_first_sequence(0); },
                "INVALID_FIELD", {"first_sequence"});
  // One that all poses have is named once.
  ExpectRefused(
      [](v1::PoseColumns* c) { c->set_covariance_diagonals(2, kNoNumber); },
      "NOT_FINITE", {"covariance_diagonals[2]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        for (int i = 0; i < 6; ++i)
          c->add_covariance_diagonals(i == 4 ? -1 : 1);
      },
      "COVARIANCE_NOT_POSITIVE_DEFINITE", {"covariance_diagonals[6]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->clear_covariance_diagonals();
        for (int i = 0; i < 18; ++i) {
          const bool is_variance = i % 6 == 0 || i % 6 == 3 || i % 6 == 5;
          c->add_covariances(i == 7 ? kNoNumber : is_variance ? 1.0 : 0.0);
        }
      },
      "NOT_FINITE", {"covariances[7]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->clear_heading_radians();
        for (int i = 0; i < 12; ++i)
          c->add_quaternions(i == 6 ? kNoNumber : 0.5);
      },
      "NOT_FINITE", {"quaternions[6]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->set_first_sequence(1);
        for (int i = 0; i < 18; ++i)
          c->add_error_transitions(i == 9 ? kNoNumber : 1);
      },
      "NOT_FINITE", {"error_transitions[9]"}, Filter(Planar()));
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->mutable_first_stamp()->set_seconds(9'214'646'399);
        c->add_stamp_step_nanos(0);
        c->add_stamp_step_nanos(1'000'000'000);
      },
      "INVALID_FIELD", {"stamp_step_nanos[1]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->mutable_first_stamp()->set_seconds(9'214'646'399);
        c->add_stamp_step_nanos(std::numeric_limits<std::int64_t>::max());
        c->add_stamp_step_nanos(0);
      },
      "INVALID_FIELD", {"stamp_step_nanos[0]"});
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->mutable_recording_start()->set_label("\x01");
      },
      "INVALID_FIELD", {"recording_start.label"});
}

TEST(PoseColumnsTest, PositionsOfTheOtherKindAreRefusedOnceForAll) {
  ExpectRefused([](v1::PoseColumns*) {}, "INVALID_FIELD", {"x_meters"},
                Geodetic(Planar()));
  ExpectRefused(
      [](v1::PoseColumns* c) {
        c->mutable_latitude_degrees()->Swap(c->mutable_x_meters());
        c->mutable_longitude_degrees()->Swap(c->mutable_y_meters());
      },
      "INVALID_FIELD", {"latitude_degrees"});
}

}  // namespace
}  // namespace revisit::server
