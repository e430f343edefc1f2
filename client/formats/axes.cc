#include "client/formats/axes.h"

#include <Eigen/Geometry>
#include <cmath>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

using Matrix3 = Eigen::Matrix3d;
using RowMajor3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;

// Maps coordinates of the file into those of the service.
struct Turn {
  Matrix3 frame;
  Matrix3 body;
};

Turn TurnOf(Axes axes) {
  Turn turn = {Matrix3::Identity(), Matrix3::Identity()};
  switch (axes) {
    case Axes::kForwardLeftUp:
    case Axes::kEastNorthUp:
      break;
    case Axes::kCamera:
      turn.frame << 0, 0, 1, -1, 0, 0, 0, -1, 0;
      turn.body = turn.frame;
      break;
    case Axes::kNorthEastDown:
      turn.frame << 0, 1, 0, 1, 0, 0, 0, 0, -1;
      turn.body.diagonal() << 1, -1, -1;
      break;
  }
  return turn;
}

// Scales yaw and its moments.
void ScaleYaw(double factor, Sample* sample) {
  sample->estimate.heading *= factor;
  if (sample->truth.has_value()) sample->truth->heading *= factor;
  if (sample->covariance.has_value()) {
    auto& [xx, xy, xh, yy, yh, hh] = *sample->covariance;
    xh *= factor;
    yh *= factor;
    hh *= factor * factor;
  }
  if (sample->error_transition.has_value()) {
    auto& f = *sample->error_transition;
    f[2] /= factor;
    f[5] /= factor;
    f[6] *= factor;
    f[7] *= factor;
  }
}

// Turns yaw clockwise from y into yaw counter-clockwise from x.
void ReadAsCompass(Sample* sample) {
  // The angle from y is the difference; its sign is turned first.
  ScaleYaw(-1.0, sample);
  sample->estimate.heading += kPi / 2.0;
  if (sample->truth.has_value()) sample->truth->heading += kPi / 2.0;
}

void ConvertAngles(Angles angles, Sample* sample) {
  if (angles == Angles::kDegrees || angles == Angles::kCompassDegrees) {
    ScaleYaw(kRadiansPerDegree, sample);
  }
  if (angles == Angles::kCompassRadians || angles == Angles::kCompassDegrees) {
    ReadAsCompass(sample);
  }
}

// North and east change places, and yaw turns the other way round.
void SwapPlane(PlanarPose* pose) {
  *pose = {pose->y, pose->x, kPi / 2.0 - pose->heading};
}

// Does so for everything that is planar.
void SwapPlane(Sample* sample) {
  SwapPlane(&sample->estimate);
  if (sample->truth.has_value()) SwapPlane(&*sample->truth);
  if (sample->covariance.has_value()) {
    const auto [xx, xy, xh, yy, yh, hh] = *sample->covariance;
    sample->covariance = {yy, xy, -yh, xx, -xh, hh};
  }
  if (sample->error_transition.has_value()) {
    const auto f = *sample->error_transition;
    sample->error_transition = {f[4],  f[3],  -f[5], f[1], f[0],
                                -f[2], -f[7], -f[6], f[8]};
  }
}

Eigen::Quaterniond Rotation(const std::array<double, 4>& q) {
  return Eigen::Quaterniond(q[3], q[0], q[1], q[2]);
}

void TurnAxes(Axes axes, Sample* sample) {
  const Turn turn = TurnOf(axes);
  const Eigen::Vector3d position =
      turn.frame *
      Eigen::Vector3d(sample->estimate.x, sample->estimate.y, sample->z);
  if (axes == Axes::kNorthEastDown) {
    SwapPlane(sample);
    if (sample->truth_z.has_value()) sample->truth_z = -*sample->truth_z;
  }
  sample->estimate.x = position.x();
  sample->estimate.y = position.y();
  sample->z = position.z();
  if (sample->quaternion.has_value()) {
    const Eigen::Quaterniond converted(
        turn.frame *
        Rotation(*sample->quaternion).normalized().toRotationMatrix() *
        turn.body.transpose());
    sample->quaternion = {converted.x(), converted.y(), converted.z(),
                          converted.w()};
  }
  if (sample->covariance_36.has_value()) {
    RowMajor6 covariance = Eigen::Map<RowMajor6>(sample->covariance_36->data());
    RowMajor6 both = RowMajor6::Zero();
    both.topLeftCorner<3, 3>() = turn.frame;
    both.bottomRightCorner<3, 3>() = turn.frame;
    Eigen::Map<RowMajor6>(sample->covariance_36->data()) =
        both * covariance * both.transpose();
    sample->covariance = PlanarPart(*sample->covariance_36);
  }
}

absl::Status CheckForCamera(const Sample& sample) {
  if (!sample.quaternion.has_value() && sample.has_heading) {
    return absl::InvalidArgumentError(
        "--axes camera needs orientations as quaternions; the file has yaw "
        "alone");
  }
  if ((sample.covariance.has_value() && !sample.covariance_36.has_value()) ||
      sample.error_transition.has_value() || sample.truth.has_value()) {
    return absl::InvalidArgumentError(
        "--axes camera needs covariances of 36 numbers and no planar truth; "
        "the file has planar ones");
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<Sample> Convert(const Sample& sample,
                               const Conventions& conventions) {
  Sample converted = sample;
  if (converted.quaternion.has_value() &&
      conventions.quaternion == QuaternionOrder::kWxyz) {
    const auto [w, x, y, z] = *converted.quaternion;
    converted.quaternion = {x, y, z, w};
  }
  ConvertAngles(conventions.angles, &converted);
  if (!converted.geodetic.has_value()) {
    if (conventions.axes == Axes::kCamera) {
      if (absl::Status status = CheckForCamera(converted); !status.ok()) {
        return status;
      }
    }
    if (conventions.axes == Axes::kCamera ||
        conventions.axes == Axes::kNorthEastDown) {
      TurnAxes(conventions.axes, &converted);
    }
  }
  if (converted.quaternion.has_value()) {
    const auto [x, y, z, w] = *converted.quaternion;
    converted.estimate.heading =
        std::atan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z);
  }
  return converted;
}

double UprightCosine(const Sample& sample) {
  if (!sample.quaternion.has_value()) return 1.0;
  const auto [x, y, z, w] = *sample.quaternion;
  const double norm = x * x + y * y + z * z + w * w;
  return norm > 0.0 ? 1.0 - 2.0 * (x * x + y * y) / norm : 1.0;
}

std::optional<std::array<double, 4>> QuaternionOf(
    const std::array<double, 9>& rotation) {
  const Matrix3 matrix = Eigen::Map<const RowMajor3>(rotation.data());
  constexpr double kTolerance = 1e-2;
  // Written so that what is not a number is refused.
  if (!((matrix * matrix.transpose() - Matrix3::Identity())
            .cwiseAbs()
            .maxCoeff() <= kTolerance) ||
      !(matrix.determinant() > 0.0)) {
    return std::nullopt;
  }
  const Eigen::Quaterniond q = Eigen::Quaterniond(matrix).normalized();
  return std::array<double, 4>{q.x(), q.y(), q.z(), q.w()};
}

}  // namespace revisit::client
