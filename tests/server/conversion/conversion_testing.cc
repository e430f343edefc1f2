#include "tests/server/conversion/conversion_testing.h"

#include <algorithm>

#include "core/geometry/pose.h"
#include "google/rpc/error_details.pb.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {

VehicleRecord RecordOf(const std::string& payload) {
  VehicleRecord record;
  record.key = 1;
  record.id = "truck";
  record.payload = payload;
  return record;
}

std::vector<std::string> FieldsOf(const absl::Status& status) {
  google::rpc::BadRequest bad_request;
  const auto payload = status.GetPayload(kBadRequestUrl);
  if (payload) bad_request.ParseFromString(std::string(*payload));
  std::vector<std::string> fields;
  for (const auto& violation : bad_request.field_violations()) {
    EXPECT_NE(violation.description(), "");
    fields.push_back(violation.field());
  }
  return fields;
}

v1::Pose PlanarPose(std::uint64_t sequence, double x) {
  v1::Pose pose;
  pose.set_sequence(sequence);
  pose.mutable_local()->set_x_meters(x);
  pose.set_heading_radians(0.5);
  SetCovariance(v1::COVARIANCE_FORM_PLANAR_6, {4.0, 0.1, 0.2, 5.0, 0.3, 0.06},
                &pose);
  return pose;
}

v1::Pose GeodeticPose(std::uint64_t sequence, double latitude, double longitude,
                      double height) {
  v1::Pose pose = PlanarPose(sequence, 0);
  pose.mutable_geodetic()->set_latitude_degrees(latitude);
  pose.mutable_geodetic()->set_longitude_degrees(longitude);
  pose.mutable_geodetic()->set_height_meters(height);
  return pose;
}

void SetCovariance(v1::CovarianceForm form, const std::vector<double>& values,
                   v1::Pose* pose) {
  pose->mutable_covariance()->set_form(form);
  pose->mutable_covariance()->mutable_values()->Assign(values.begin(),
                                                       values.end());
}

std::vector<double> RosMatrix() {
  std::vector<double> values(36);
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c < 6; ++c) {
      values[static_cast<std::size_t>(6 * r + c)] =
          r == c ? 10.0 + r : 0.01 * (10 * std::min(r, c) + std::max(r, c));
    }
  }
  return values;
}

VehicleConfig Planar() { return {}; }

VehicleConfig Spatial() {
  VehicleConfig config;
  config.drive.state_space = core::StateSpace::kSpatial;
  return config;
}

VehicleConfig Filter(VehicleConfig config) {
  config.drive.search.correlation_model = core::CorrelationModel::kFilter;
  return config;
}

VehicleConfig Geodetic(VehicleConfig config) {
  config.frame = CoordinateFrame::kGeodetic;
  return config;
}

Poses PosesOf(const std::vector<v1::Pose>& poses) {
  return Poses(poses.begin(), poses.end());
}

absl::StatusOr<DecodedBatch> DecodeAll(const std::vector<v1::Pose>& poses,
                                       const VehicleConfig& config) {
  const Poses sent = PosesOf(poses);
  return DecodeBatch({&sent, nullptr}, kMaxPoses, config, FieldPath());
}

absl::StatusOr<core::PoseSample> DecodeOne(const v1::Pose& pose,
                                           const VehicleConfig& config) {
  absl::StatusOr<DecodedBatch> batch = DecodeAll({pose}, config);
  if (!batch.ok()) return batch.status();
  return batch->samples[0];
}

std::array<double, 10> UpperOf(const absl::StatusOr<core::PoseSample>& sample) {
  EXPECT_THAT(sample, IsOk());
  return sample.ok() ? sample->covariance.upper : std::array<double, 10>{};
}

}  // namespace revisit::server
