#include "server/records/stored_columns.h"

#include <cstdint>
#include <limits>
#include <random>
#include <string>

#include "google/protobuf/repeated_field.h"
#include "gtest/gtest.h"
#include "revisit/v1/pose_columns.pb.h"
#include "server/records/stored_records.pb.h"
#include "tests/random.h"

namespace revisit::server {
namespace {

// The slow and obvious way: the messages are alike.
std::string Serialized(const v1::PoseColumns& columns) {
  stored::PoseBatch batch;
  EXPECT_TRUE(
      batch.add_columns()->ParseFromString(columns.SerializeAsString()));
  batch.DiscardUnknownFields();
  return batch.SerializeAsString();
}

// Numbers of all lengths, in columns of any length, fitting or not.
v1::PoseColumns AnyColumns(std::mt19937_64& random) {
  const auto below = [&](int end) { return UniformInt(random, 0, end - 1); };
  const auto integer = [&] { return random() >> below(64); };
  v1::PoseColumns columns;
  columns.set_first_sequence(below(3) == 0 ? 0 : integer());
  columns.set_pose_count(static_cast<std::int32_t>(integer()));
  if (below(2) == 0) {
    auto* const stamp = columns.mutable_first_stamp();
    stamp->set_seconds(static_cast<std::int64_t>(integer()));
    stamp->set_nanos(static_cast<std::int32_t>(integer()));
  }
  for (int i = below(4); i > 0; --i) {
    const auto step = static_cast<std::int64_t>(integer());
    columns.add_stamp_step_nanos(below(2) == 0 ? step : -step);
  }
  for (google::protobuf::RepeatedField<double>* column :
       {columns.mutable_x_meters(), columns.mutable_y_meters(),
        columns.mutable_z_meters(), columns.mutable_latitude_degrees(),
        columns.mutable_longitude_degrees(), columns.mutable_height_meters(),
        columns.mutable_heading_radians(), columns.mutable_quaternions(),
        columns.mutable_covariances(), columns.mutable_covariance_diagonals(),
        columns.mutable_error_transitions()}) {
    for (int i = below(2) == 0 ? 0 : below(40); i > 0; --i) {
      static constexpr double kNumbers[] = {
          0.0, -0.0, 1.5, std::numeric_limits<double>::quiet_NaN()};
      column->Add(kNumbers[below(4)]);
    }
  }
  columns.set_covariance_form(static_cast<v1::CovarianceForm>(below(6) - 1));
  if (below(2) == 0) {
    columns.mutable_recording_start()->set_label(
        std::string(static_cast<std::size_t>(below(200)), 'a'));
    if (below(2) == 0) columns.mutable_recording_start()->set_unknown(true);
  }
  return columns;
}

TEST(StoredColumnsTest, HaveTheBytesOfTheirMessage) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 5000; ++trial) {
    const v1::PoseColumns columns = AnyColumns(random);
    ASSERT_EQ(EncodeColumns(ColumnFieldsOf(columns)), Serialized(columns))
        << columns.DebugString();
  }
}

TEST(StoredColumnsTest, FieldsThatAreNotKnownAreLeftOut) {
  v1::PoseColumns columns;
  columns.mutable_first_stamp()->set_nanos(1);
  columns.add_x_meters(1.0);
  const std::string known = EncodeColumns(ColumnFieldsOf(columns));
  for (google::protobuf::Message* message :
       {static_cast<google::protobuf::Message*>(&columns),
        static_cast<google::protobuf::Message*>(
            columns.mutable_first_stamp())}) {
    message->GetReflection()->MutableUnknownFields(message)->AddVarint(1000, 1);
  }
  EXPECT_EQ(EncodeColumns(ColumnFieldsOf(columns)), known);
}

}  // namespace
}  // namespace revisit::server
