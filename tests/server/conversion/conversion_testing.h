// Messages and configs that the tests of conversion share.
#ifndef REVISIT_TESTS_SERVER_CONVERSION_CONVERSION_TESTING_H_
#define REVISIT_TESTS_SERVER_CONVERSION_CONVERSION_TESTING_H_

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/geometry/pose.h"
#include "google/protobuf/text_format.h"
#include "gtest/gtest.h"
#include "server/conversion/poses.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Most poses of a batch in these tests.
inline constexpr int kMaxPoses = 100;

template <typename Message>
Message FromText(const std::string& text) {
  Message message;
  EXPECT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &message))
      << text;
  return message;
}

// The record of a vehicle "truck" with this payload.
VehicleRecord RecordOf(const std::string& payload);

// The fields that a status names as wrong, in order.
std::vector<std::string> FieldsOf(const absl::Status& status);

// A local pose with a heading of 0.5 and a PLANAR_6 covariance.
v1::Pose PlanarPose(std::uint64_t sequence, double x);
// The same at a geodetic position.
v1::Pose GeodeticPose(std::uint64_t sequence, double latitude, double longitude,
                      double height);

void SetCovariance(v1::CovarianceForm form, const std::vector<double>& values,
                   v1::Pose* pose);

// A 6x6 of (x, y, z, rotX, rotY, rotZ) whose entry (r, c) is
// 0.01 * (10 * min + max), but for a diagonal that makes it positive definite.
std::vector<double> RosMatrix();

VehicleConfig Planar();
VehicleConfig Spatial();
VehicleConfig Filter(VehicleConfig config);
VehicleConfig Geodetic(VehicleConfig config);

Poses PosesOf(const std::vector<v1::Pose>& poses);

absl::StatusOr<DecodedBatch> DecodeAll(const std::vector<v1::Pose>& poses,
                                       const VehicleConfig& config);
absl::StatusOr<core::PoseSample> DecodeOne(const v1::Pose& pose,
                                           const VehicleConfig& config);

// The upper triangle over (x, y, z, heading), by rows.
std::array<double, 10> UpperOf(const absl::StatusOr<core::PoseSample>& sample);

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_CONVERSION_CONVERSION_TESTING_H_
