#include "client/cli/drive_poses.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/cli/console.h"

namespace revisit::client {

v1::Pose MakePose(const Drive& drive,
                  const std::vector<ClaimedUncertainty>& uncertainty,
                  v1::StateSpace state_space, std::size_t index) {
  const DriveSample& sample = drive.samples[index];
  const auto& [xx, xy, xh, yy, yh, hh] = uncertainty[index].planar;
  v1::Pose pose;
  pose.set_sequence(index + 1);
  const double seconds = std::floor(sample.time_seconds);
  pose.mutable_stamp()->set_seconds(static_cast<std::int64_t>(seconds));
  pose.mutable_stamp()->set_nanos(static_cast<std::int32_t>(std::min(
      std::floor((sample.time_seconds - seconds) * 1e9 + 0.5), 999'999'999.0)));
  if (sample.geodetic.has_value()) {
    v1::GeodeticPosition* geodetic = pose.mutable_geodetic();
    geodetic->set_latitude_degrees(sample.geodetic->latitude_degrees);
    geodetic->set_longitude_degrees(sample.geodetic->longitude_degrees);
    geodetic->set_height_meters(sample.geodetic->height_meters);
  } else {
    v1::LocalPosition* local = pose.mutable_local();
    local->set_x_meters(sample.estimate.x);
    local->set_y_meters(sample.estimate.y);
    local->set_z_meters(sample.estimate_z);
  }
  if (sample.quaternion.has_value()) {
    const auto& [x, y, z, w] = *sample.quaternion;
    v1::Quaternion* quaternion = pose.mutable_quaternion();
    quaternion->set_x(x);
    quaternion->set_y(y);
    quaternion->set_z(z);
    quaternion->set_w(w);
  } else {
    pose.set_heading_radians(sample.estimate.heading);
  }
  v1::Covariance* covariance = pose.mutable_covariance();
  if (state_space == v1::STATE_SPACE_SPATIAL) {
    const double zz = uncertainty[index].z_variance;
    covariance->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
    for (const double value : {xx, xy, 0.0, xh, yy, 0.0, yh, zz, 0.0, hh}) {
      covariance->add_values(value);
    }
  } else {
    covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {xx, xy, xh, yy, yh, hh}) {
      covariance->add_values(value);
    }
  }
  return pose;
}

void AppendPoses(const Drive& drive,
                 const std::vector<ClaimedUncertainty>& uncertainty,
                 v1::StateSpace state_space, const SampleRange& range,
                 std::size_t batch_poses, PoseStream* stream) {
  for (std::size_t next = range.begin; next < range.end;) {
    v1::PoseBatch batch;
    const std::size_t end = std::min(range.end, next + batch_poses);
    for (; next < end; ++next) {
      *batch.add_poses() = MakePose(drive, uncertainty, state_space, next);
    }
    if (!stream->Append(std::move(batch)).ok()) return;
  }
}

std::string JumpText(const v1::Jump& jump) {
  return absl::StrCat("jump of ", Fixed(jump.distance_meters(), 1),
                      " m before sequence ", jump.sequence());
}

}  // namespace revisit::client
