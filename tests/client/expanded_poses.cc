#include "tests/client/expanded_poses.h"

#include <cstdint>

namespace revisit::client {
namespace {

constexpr std::int64_t kNanosPerSecond = 1'000'000'000;

void SetCovariance(const v1::PoseColumns& columns, int i,
                   v1::Covariance* covariance) {
  const v1::CovarianceForm form = columns.covariance_form();
  covariance->set_form(form);
  const bool is_full = form == v1::COVARIANCE_FORM_ROS_36;
  const int size = form == v1::COVARIANCE_FORM_PLANAR_6 ? 3 : is_full ? 6 : 4;
  const int values = is_full ? 36 : size * (size + 1) / 2;
  if (columns.covariance_diagonals().empty()) {
    const int first = columns.covariances_size() == values ? 0 : i * values;
    for (int k = 0; k < values; ++k) {
      covariance->add_values(columns.covariances(first + k));
    }
    return;
  }
  const int first = columns.covariance_diagonals_size() == size ? 0 : i * size;
  for (int r = 0; r < size; ++r) {
    for (int c = is_full ? 0 : r; c < size; ++c) {
      covariance->add_values(r == c ? columns.covariance_diagonals(first + r)
                                    : 0.0);
    }
  }
}

}  // namespace

v1::PoseBatch Expanded(const v1::PoseBatch& batch) {
  if (!batch.has_columns()) return batch;
  const v1::PoseColumns& columns = batch.columns();
  v1::PoseBatch expanded;
  std::int64_t stamp_ns = columns.first_stamp().seconds() * kNanosPerSecond +
                          columns.first_stamp().nanos();
  const int transitions = columns.error_transitions_size();
  const int count = columns.pose_count();
  const bool first_has_none =
      transitions == 9 * (count - 1) || transitions == 16 * (count - 1);
  const int numbers =
      transitions == 0 ? 0 : transitions / (first_has_none ? count - 1 : count);
  for (int i = 0; i < count; ++i) {
    v1::Pose& pose = *expanded.add_poses();
    pose.set_sequence(columns.first_sequence() + static_cast<std::uint64_t>(i));
    if (columns.has_first_stamp()) {
      if (i > 0) stamp_ns += columns.stamp_step_nanos(i - 1);
      std::int64_t nanos = stamp_ns % kNanosPerSecond;
      if (nanos < 0) nanos += kNanosPerSecond;
      pose.mutable_stamp()->set_nanos(static_cast<std::int32_t>(nanos));
      pose.mutable_stamp()->set_seconds((stamp_ns - nanos) / kNanosPerSecond);
    }
    if (!columns.x_meters().empty()) {
      pose.mutable_local()->set_x_meters(columns.x_meters(i));
      pose.mutable_local()->set_y_meters(columns.y_meters(i));
      if (!columns.z_meters().empty()) {
        pose.mutable_local()->set_z_meters(columns.z_meters(i));
      }
    } else {
      auto* const geodetic = pose.mutable_geodetic();
      geodetic->set_latitude_degrees(columns.latitude_degrees(i));
      geodetic->set_longitude_degrees(columns.longitude_degrees(i));
      if (!columns.height_meters().empty()) {
        geodetic->set_height_meters(columns.height_meters(i));
      }
    }
    if (!columns.quaternions().empty()) {
      auto* const turn = pose.mutable_quaternion();
      turn->set_x(columns.quaternions(4 * i));
      turn->set_y(columns.quaternions(4 * i + 1));
      turn->set_z(columns.quaternions(4 * i + 2));
      turn->set_w(columns.quaternions(4 * i + 3));
    } else {
      pose.set_heading_radians(columns.heading_radians(i));
    }
    SetCovariance(columns, i, pose.mutable_covariance());
    if (i > 0 || !first_has_none) {
      const int first = (first_has_none ? i - 1 : i) * numbers;
      for (int k = 0; k < numbers; ++k) {
        pose.add_error_transition(columns.error_transitions(first + k));
      }
    }
    if (i == 0 && columns.has_recording_start()) {
      *pose.mutable_recording_start() = columns.recording_start();
    }
  }
  return expanded;
}

}  // namespace revisit::client
