#include "tests/client/expanded_poses.h"

#include <cstdint>

namespace revisit::client {
namespace {

constexpr std::int64_t kNanosPerSecond = 1'000'000'000;

double At(const google::protobuf::RepeatedField<double>& column, int i) {
  return column.empty() ? 0.0 : column[i];
}

void SetCovariance(const v1::PoseColumns& columns, int i,
                   v1::Covariance* covariance) {
  const v1::CovarianceForm form = columns.covariance_form();
  covariance->set_form(form);
  const bool is_full = form == v1::COVARIANCE_FORM_ROS_36;
  const int size = form == v1::COVARIANCE_FORM_PLANAR_6 ? 3 : is_full ? 6 : 4;
  int values = is_full ? 36 : size * (size + 1) / 2;
  if (form == v1::COVARIANCE_FORM_UNSPECIFIED) {
    values = columns.covariances_size() / columns.pose_count();
  }
  const int variances = columns.covariance_diagonals_size();
  if (columns.covariances_size() > 0) {
    const int first = columns.covariances_size() == values ? 0 : i * values;
    for (int k = 0; k < values; ++k) {
      covariance->add_values(columns.covariances(first + k));
    }
  } else if (variances > 0) {
    const int first = variances == size ? 0 : i * size;
    for (int r = 0; r < size; ++r) {
      for (int c = is_full ? 0 : r; c < size; ++c) {
        covariance->add_values(r == c ? columns.covariance_diagonals(first + r)
                                      : 0.0);
      }
    }
  }
}

void SetPosition(const v1::PoseColumns& columns, int i, v1::Pose* pose) {
  if (columns.x_meters_size() + columns.y_meters_size() +
          columns.z_meters_size() >
      0) {
    pose->mutable_local()->set_x_meters(At(columns.x_meters(), i));
    pose->mutable_local()->set_y_meters(At(columns.y_meters(), i));
    pose->mutable_local()->set_z_meters(At(columns.z_meters(), i));
  }
  if (columns.latitude_degrees_size() + columns.longitude_degrees_size() +
          columns.height_meters_size() >
      0) {
    auto* const geodetic = pose->mutable_geodetic();
    geodetic->set_latitude_degrees(At(columns.latitude_degrees(), i));
    geodetic->set_longitude_degrees(At(columns.longitude_degrees(), i));
    geodetic->set_height_meters(At(columns.height_meters(), i));
  }
}

void SetOrientation(const v1::PoseColumns& columns, int i, v1::Pose* pose) {
  if (!columns.quaternions().empty()) {
    auto* const turn = pose->mutable_quaternion();
    turn->set_x(columns.quaternions(4 * i));
    turn->set_y(columns.quaternions(4 * i + 1));
    turn->set_z(columns.quaternions(4 * i + 2));
    turn->set_w(columns.quaternions(4 * i + 3));
  } else if (!columns.heading_radians().empty()) {
    pose->set_heading_radians(columns.heading_radians(i));
  }
}

}  // namespace

void AddExpanded(const v1::PoseColumns& columns,
                 google::protobuf::RepeatedPtrField<v1::Pose>* poses) {
  std::int64_t stamp_ns = columns.first_stamp().seconds() * kNanosPerSecond +
                          columns.first_stamp().nanos();
  const int transitions = columns.error_transitions_size();
  const int count = columns.pose_count();
  const bool first_has_none =
      transitions == 9 * (count - 1) || transitions == 16 * (count - 1);
  const int numbers =
      transitions == 0 ? 0 : transitions / (first_has_none ? count - 1 : count);
  for (int i = 0; i < count; ++i) {
    v1::Pose& pose = *poses->Add();
    if (columns.first_sequence() > 0) {
      pose.set_sequence(columns.first_sequence() +
                        static_cast<std::uint64_t>(i));
    }
    if (columns.has_first_stamp()) {
      if (i > 0) stamp_ns += columns.stamp_step_nanos(i - 1);
      std::int64_t nanos = stamp_ns % kNanosPerSecond;
      if (nanos < 0) nanos += kNanosPerSecond;
      pose.mutable_stamp()->set_nanos(static_cast<std::int32_t>(nanos));
      pose.mutable_stamp()->set_seconds((stamp_ns - nanos) / kNanosPerSecond);
    }
    SetPosition(columns, i, &pose);
    SetOrientation(columns, i, &pose);
    if (columns.covariance_form() != v1::COVARIANCE_FORM_UNSPECIFIED ||
        !columns.covariances().empty()) {
      SetCovariance(columns, i, pose.mutable_covariance());
    }
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
}

v1::PoseBatch Expanded(const v1::PoseBatch& batch) {
  if (!batch.has_columns()) return batch;
  v1::PoseBatch expanded;
  AddExpanded(batch.columns(), expanded.mutable_poses());
  return expanded;
}

}  // namespace revisit::client
