#include "client/trajectory/local_pose.h"

#include <Eigen/Geometry>
#include <GeographicLib/LocalCartesian.hpp>
#include <cmath>
#include <vector>

#include "client/formats/angles.h"

namespace revisit::client {

using Matrix4 = Eigen::Matrix<double, 4, 4, Eigen::RowMajor>;

struct LocalFrame::Origin {
  GeographicLib::LocalCartesian plane;
};

namespace {

std::optional<Matrix4> TransitionOf(const v1::Pose& pose, bool spatial) {
  const int size = spatial ? 4 : 3;
  if (pose.error_transition_size() != size * size) return std::nullopt;
  constexpr int kPlanar[3] = {0, 1, 3};
  constexpr int kSpatial[4] = {0, 1, 2, 3};
  const int* places = spatial ? kSpatial : kPlanar;
  Matrix4 m = Matrix4::Identity();
  for (int r = 0; r < size; ++r) {
    for (int c = 0; c < size; ++c) {
      m(places[r], places[c]) = pose.error_transition(size * r + c);
    }
  }
  return m;
}

StateMatrix ToArray(const Matrix4& m) {
  StateMatrix array;
  Eigen::Map<Matrix4>(array.data()) = m;
  return array;
}

double HeadingOf(const Eigen::Vector3d& forward) {
  return std::atan2(forward.y(), forward.x());
}

// `turn` leads from the frame in which the pose is given to the vehicle's.
void SetOrientation(const v1::Pose& pose, const Eigen::Matrix3d& turn,
                    LocalPose* local) {
  Eigen::Quaterniond orientation;
  if (pose.has_quaternion()) {
    const v1::Quaternion& q = pose.quaternion();
    orientation = turn * Eigen::Quaterniond(q.w(), q.x(), q.y(), q.z())
                             .normalized()
                             .toRotationMatrix();
    local->heading = HeadingOf(orientation * Eigen::Vector3d::UnitX());
  } else {
    const double heading = pose.heading_radians();
    local->heading = HeadingOf(
        turn * Eigen::Vector3d(std::cos(heading), std::sin(heading), 0.0));
    orientation = Eigen::AngleAxisd(local->heading, Eigen::Vector3d::UnitZ());
  }
  local->orientation = {orientation.x(), orientation.y(), orientation.z(),
                        orientation.w()};
}

void SetUncertainty(const v1::Pose& pose, const Eigen::Matrix3d& turn,
                    bool spatial, LocalPose* local) {
  // The heading's own factor differs from 1 by the curvature of the earth
  // between the two frames, some 1e-8 over a kilometre.
  Matrix4 jacobian = Matrix4::Identity();
  jacobian.topLeftCorner<3, 3>() = turn;
  if (!spatial) {
    jacobian.row(2) = jacobian.col(2).transpose() =
        Eigen::RowVector4d(0.0, 0.0, 1.0, 0.0);
  }
  StateMatrix given = StateCovariance(pose.covariance());
  Eigen::Map<Matrix4> covariance(given.data());
  if (!spatial) {
    covariance.row(2).setZero();
    covariance.col(2).setZero();
  }
  local->covariance = ToArray(jacobian * covariance * jacobian.transpose());
  if (const auto transition = TransitionOf(pose, spatial)) {
    local->error_transition =
        ToArray(jacobian * *transition * jacobian.inverse());
  }
}

}  // namespace

StateMatrix StateCovariance(const v1::Covariance& covariance) {
  // The rows of the state among those of the form.
  constexpr int kPlanar[3] = {0, 1, 3};
  constexpr int kRos[4] = {0, 1, 2, 5};
  // A server may send fewer numbers than the form has.
  const auto value = [&covariance](int i) {
    return i < covariance.values_size() ? covariance.values(i) : 0.0;
  };
  Matrix4 m = Matrix4::Zero();
  if (covariance.form() == v1::COVARIANCE_FORM_ROS_36) {
    for (int r = 0; r < 4; ++r) {
      for (int c = 0; c < 4; ++c) m(r, c) = value(6 * kRos[r] + kRos[c]);
    }
    return ToArray(m);
  }
  const bool planar = covariance.form() == v1::COVARIANCE_FORM_PLANAR_6;
  const int size = planar ? 3 : 4;
  int next = 0;
  for (int r = 0; r < size; ++r) {
    for (int c = r; c < size; ++c, ++next) {
      const int row = planar ? kPlanar[r] : r;
      const int column = planar ? kPlanar[c] : c;
      m(row, column) = m(column, row) = value(next);
    }
  }
  return ToArray(m);
}

v1::Covariance ToCovariance(const StateMatrix& matrix, bool spatial) {
  v1::Covariance covariance;
  covariance.set_form(spatial ? v1::COVARIANCE_FORM_SPATIAL_10
                              : v1::COVARIANCE_FORM_PLANAR_6);
  for (std::size_t row = 0; row < 4; ++row) {
    for (std::size_t column = row; column < 4; ++column) {
      if (!spatial && (row == 2 || column == 2)) continue;
      covariance.add_values(matrix[4 * row + column]);
    }
  }
  return covariance;
}

void SetErrorTransition(const StateMatrix& matrix, bool spatial,
                        v1::Pose* pose) {
  pose->clear_error_transition();
  for (std::size_t row = 0; row < 4; ++row) {
    for (std::size_t column = 0; column < 4; ++column) {
      if (!spatial && (row == 2 || column == 2)) continue;
      pose->add_error_transition(matrix[4 * row + column]);
    }
  }
}

void SetQuaternion(const std::array<double, 4>& orientation, v1::Pose* pose) {
  v1::Quaternion* const quaternion = pose->mutable_quaternion();
  quaternion->set_x(orientation[0]);
  quaternion->set_y(orientation[1]);
  quaternion->set_z(orientation[2]);
  quaternion->set_w(orientation[3]);
}

LocalPose InOuterFrame(const LocalPose& pose, const v1::StatePose& frame) {
  const double turn = frame.heading_radians();
  const double c = std::cos(turn);
  const double s = std::sin(turn);
  const auto& [x, y, z] = pose.position;
  LocalPose moved = pose;
  moved.position = {frame.x_meters() + c * x - s * y,
                    frame.y_meters() + s * x + c * y, frame.z_meters() + z};
  moved.orientation = Turned(pose.orientation, turn);
  moved.heading = std::remainder(pose.heading + turn, 2.0 * kPi);
  Matrix4 jacobian = Matrix4::Identity();
  jacobian(0, 0) = jacobian(1, 1) = c;
  jacobian(0, 1) = -s;
  jacobian(1, 0) = s;
  const auto in_outer_axes = [&jacobian](const StateMatrix& matrix) {
    const Matrix4 inner = Eigen::Map<const Matrix4>(matrix.data());
    return ToArray(jacobian * inner * jacobian.transpose());
  };
  moved.covariance = in_outer_axes(pose.covariance);
  if (pose.error_transition) {
    moved.error_transition = in_outer_axes(*pose.error_transition);
  }
  return moved;
}

std::array<double, 4> Turned(const std::array<double, 4>& orientation,
                             double radians) {
  const auto& [x, y, z, w] = orientation;
  const Eigen::Quaterniond turned =
      Eigen::AngleAxisd(radians, Eigen::Vector3d::UnitZ()) *
      Eigen::Quaterniond(w, x, y, z);
  return {turned.x(), turned.y(), turned.z(), turned.w()};
}

LocalFrame::LocalFrame(const v1::VehicleSettings& settings)
    : spatial_(settings.state_space() == v1::STATE_SPACE_SPATIAL) {
  if (!settings.has_geodetic_origin()) return;
  const v1::GeodeticPosition& at = settings.geodetic_origin();
  origin_ = std::make_unique<Origin>(Origin{GeographicLib::LocalCartesian(
      at.latitude_degrees(), at.longitude_degrees(), at.height_meters())});
}

LocalFrame::~LocalFrame() = default;

LocalPose LocalFrame::Localize(const v1::Pose& pose) const {
  LocalPose local;
  local.sequence = pose.sequence();
  if (pose.has_stamp()) local.stamp = pose.stamp();
  if (pose.has_recording_start()) {
    local.recording_start = pose.recording_start();
  }
  // From the frame in which the pose is given to the vehicle's.
  Eigen::Matrix3d turn = Eigen::Matrix3d::Identity();
  if (pose.has_geodetic() && origin_ != nullptr) {
    const v1::GeodeticPosition& at = pose.geodetic();
    std::vector<double> rotation(9);
    origin_->plane.Forward(at.latitude_degrees(), at.longitude_degrees(),
                           at.height_meters(), local.position[0],
                           local.position[1], local.position[2], rotation);
    turn = Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(
        rotation.data());
  } else {
    local.position = {pose.local().x_meters(), pose.local().y_meters(),
                      pose.local().z_meters()};
  }
  SetOrientation(pose, turn, &local);
  SetUncertainty(pose, turn, spatial_, &local);
  return local;
}

v1::GeodeticPosition LocalFrame::ToGeodetic(
    const std::array<double, 3>& position) const {
  double latitude = 0.0;
  double longitude = 0.0;
  double height = 0.0;
  origin_->plane.Reverse(position[0], position[1], position[2], latitude,
                         longitude, height);
  v1::GeodeticPosition geodetic;
  geodetic.set_latitude_degrees(latitude);
  geodetic.set_longitude_degrees(longitude);
  geodetic.set_height_meters(height);
  return geodetic;
}

}  // namespace revisit::client
