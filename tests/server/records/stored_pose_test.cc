#include "server/records/stored_pose.h"

#include <cstdint>
#include <limits>
#include <random>
#include <string>

#include "gtest/gtest.h"
#include "revisit/v1/geometry.pb.h"
#include "server/records/stored_records.pb.h"
#include "tests/random.h"

namespace revisit::server {
namespace {

std::string BytesOf(const v1::Pose& pose) {
  const PoseFields fields = PoseFieldsOf(pose);
  const StoredPose stored(fields);
  // A byte more shows whether it stays within its size.
  std::string bytes(stored.size() + 1, '#');
  auto* const begin = reinterpret_cast<std::uint8_t*>(&bytes[0]);
  EXPECT_EQ(stored.Write(fields, begin), begin + stored.size());
  EXPECT_EQ(bytes.back(), '#');
  bytes.pop_back();
  return bytes;
}

// The slow and obvious way: the messages are alike.
std::string Serialized(const v1::Pose& pose) {
  stored::Pose stored;
  EXPECT_TRUE(stored.ParseFromString(pose.SerializeAsString()));
  stored.DiscardUnknownFields();
  return stored.SerializeAsString();
}

// Numbers of all lengths, and those that a writer could mistake for nothing.
class Numbers {
 public:
  bool Coin() { return Below(2) == 1; }
  int Below(int end) { return UniformInt(random_, 0, end - 1); }
  std::uint64_t Integer() { return random_() >> Below(64); }
  double Double() {
    switch (Below(6)) {
      case 0:
        return 0.0;
      case 1:
        return -0.0;
      case 2:
        return std::numeric_limits<double>::quiet_NaN();
      case 3:
        return -std::numeric_limits<double>::infinity();
      case 4:
        return std::numeric_limits<double>::denorm_min();
      default:
        return Normal(random_, 1e3);
    }
  }

 private:
  std::mt19937_64 random_ = SeededRandom();
};

void SetAnyCovariance(Numbers* numbers, v1::Covariance* covariance) {
  covariance->set_form(static_cast<v1::CovarianceForm>(numbers->Below(6) - 1));
  static constexpr int kSizes[] = {0, 1, 6, 10, 15, 16, 36};
  const int size = kSizes[numbers->Below(7)];
  for (int i = 0; i < size; ++i) covariance->add_values(numbers->Double());
}

void SetAnyStart(Numbers* numbers, v1::RecordingStart* start) {
  static const std::string kTexts[] = {"", "a", std::string(200, 'b')};
  start->set_label(kTexts[numbers->Below(3)]);
  switch (numbers->Below(4)) {
    case 0:
      SetAnyCovariance(numbers, start->mutable_after());
      break;
    case 1: {
      v1::Datum* const datum = start->mutable_datum();
      datum->set_datum_id(kTexts[numbers->Below(3)]);
      if (numbers->Coin()) {
        datum->mutable_pose()->set_x_meters(numbers->Double());
        datum->mutable_pose()->set_y_meters(numbers->Double());
        datum->mutable_pose()->set_z_meters(numbers->Double());
        datum->mutable_pose()->set_heading_radians(numbers->Double());
      }
      if (numbers->Coin()) {
        SetAnyCovariance(numbers, datum->mutable_covariance());
      }
      break;
    }
    case 2:
      start->set_unknown(numbers->Coin());
      break;
    default:
      break;
  }
}

v1::Pose AnyPose(Numbers* numbers) {
  v1::Pose pose;
  if (numbers->Coin()) pose.set_sequence(numbers->Integer());
  if (numbers->Coin()) {
    auto* const stamp = pose.mutable_stamp();
    stamp->set_seconds(static_cast<std::int64_t>(numbers->Integer()));
    stamp->set_nanos(static_cast<std::int32_t>(numbers->Integer()));
    if (numbers->Coin()) stamp->set_seconds(-stamp->seconds());
  }
  switch (numbers->Below(3)) {
    case 0:
      pose.mutable_local()->set_x_meters(numbers->Double());
      pose.mutable_local()->set_y_meters(numbers->Double());
      pose.mutable_local()->set_z_meters(numbers->Double());
      break;
    case 1:
      pose.mutable_geodetic()->set_latitude_degrees(numbers->Double());
      pose.mutable_geodetic()->set_longitude_degrees(numbers->Double());
      pose.mutable_geodetic()->set_height_meters(numbers->Double());
      break;
    default:
      break;
  }
  switch (numbers->Below(3)) {
    case 0:
      pose.mutable_quaternion()->set_x(numbers->Double());
      pose.mutable_quaternion()->set_y(numbers->Double());
      pose.mutable_quaternion()->set_z(numbers->Double());
      pose.mutable_quaternion()->set_w(numbers->Double());
      break;
    case 1:
      pose.set_heading_radians(numbers->Double());
      break;
    default:
      break;
  }
  if (numbers->Coin()) SetAnyCovariance(numbers, pose.mutable_covariance());
  static constexpr int kSizes[] = {0, 0, 9, 16};
  const int size = kSizes[numbers->Below(4)];
  for (int i = 0; i < size; ++i) {
    pose.add_error_transition(numbers->Double());
  }
  if (numbers->Coin()) SetAnyStart(numbers, pose.mutable_recording_start());
  return pose;
}

TEST(StoredPoseTest, BytesAreThoseOfTheSerializedMessage) {
  Numbers numbers;
  EXPECT_EQ(BytesOf(v1::Pose()), Serialized(v1::Pose()));
  for (int i = 0; i < 20'000; ++i) {
    const v1::Pose pose = AnyPose(&numbers);
    ASSERT_EQ(BytesOf(pose), Serialized(pose)) << pose.DebugString();
  }
}

// A field that is added to the API, and not to the store, is not stored. One
// that is added to the store has to be named in stored_pose.cc, in PoseFields,
// and above.
TEST(StoredPoseTest, OnlyFieldsOfTheStoreAreWritten) {
  Numbers numbers;
  v1::Pose pose = AnyPose(&numbers);
  const std::string before = BytesOf(pose);
  pose.GetReflection()->MutableUnknownFields(&pose)->AddVarint(99, 7);
  EXPECT_EQ(BytesOf(pose), before);
  EXPECT_EQ(stored::Pose::descriptor()->field_count(), 9);
  EXPECT_EQ(stored::RecordingStart::descriptor()->field_count(), 4);
  EXPECT_EQ(stored::Datum::descriptor()->field_count(), 3);
  EXPECT_EQ(stored::StatePose::descriptor()->field_count(), 4);
  EXPECT_EQ(stored::Covariance::descriptor()->field_count(), 2);
  EXPECT_EQ(stored::LocalPosition::descriptor()->field_count(), 3);
  EXPECT_EQ(stored::GeodeticPosition::descriptor()->field_count(), 3);
  EXPECT_EQ(stored::Quaternion::descriptor()->field_count(), 4);
}

}  // namespace
}  // namespace revisit::server
