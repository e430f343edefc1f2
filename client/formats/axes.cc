#include "client/formats/axes.h"

#include <Eigen/Geometry>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

using Matrix3 = Eigen::Matrix3d;
using RowMajor3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;

// Maps the frame's coordinates in the file into those of the service.
Matrix3 FrameOf(Axes axes) {
  Matrix3 frame = Matrix3::Identity();
  if (axes == Axes::kCamera) frame << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  if (axes == Axes::kNorthEastDown) frame << 0, 1, 0, 1, 0, 0, 0, 0, -1;
  return frame;
}

// The direction of a letter, forward, left and up; 0 of any other letter.
Eigen::Vector3d DirectionOf(char letter) {
  switch (letter) {
    case 'f':
      return {1, 0, 0};
    case 'b':
      return {-1, 0, 0};
    case 'l':
      return {0, 1, 0};
    case 'r':
      return {0, -1, 0};
    case 'u':
      return {0, 0, 1};
    case 'd':
      return {0, 0, -1};
    default:
      return {0, 0, 0};
  }
}

Matrix3 MatrixOf(const BodyAxes& body) {
  Matrix3 matrix;
  for (int axis = 0; axis < 3; ++axis) {
    matrix.col(axis) = DirectionOf(body[static_cast<std::size_t>(axis)]);
  }
  return matrix;
}

// Maps coordinates of the file's body into those of the vehicle.
Matrix3 BodyOf(const Conventions& conventions) {
  BodyAxes body = {'f', 'l', 'u'};
  if (conventions.axes == Axes::kCamera) body = {'r', 'd', 'f'};
  if (conventions.axes == Axes::kNorthEastDown) body = {'f', 'r', 'd'};
  const Matrix3 matrix = MatrixOf(conventions.body.value_or(body));
  if (conventions.body_yaw == 0.0) return matrix;
  return Eigen::AngleAxisd(conventions.body_yaw, Eigen::Vector3d::UnitZ())
             .toRotationMatrix() *
         matrix;
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

void TurnFrame(Axes axes, const Matrix3& frame, Sample* sample) {
  const Eigen::Vector3d position =
      frame *
      Eigen::Vector3d(sample->estimate.x, sample->estimate.y, sample->z);
  if (axes == Axes::kNorthEastDown) {
    SwapPlane(sample);
    if (sample->truth_z.has_value()) sample->truth_z = -*sample->truth_z;
  }
  sample->estimate.x = position.x();
  sample->estimate.y = position.y();
  sample->z = position.z();
  if (sample->covariance_36.has_value()) {
    RowMajor6 covariance = Eigen::Map<RowMajor6>(sample->covariance_36->data());
    RowMajor6 both = RowMajor6::Zero();
    both.topLeftCorner<3, 3>() = frame;
    both.bottomRightCorner<3, 3>() = frame;
    Eigen::Map<RowMajor6>(sample->covariance_36->data()) =
        both * covariance * both.transpose();
    sample->covariance = PlanarPart(*sample->covariance_36);
  }
}

void TurnOrientation(const Matrix3& frame, const Matrix3& body,
                     Sample* sample) {
  const Eigen::Quaterniond converted(
      frame * Rotation(*sample->quaternion).normalized().toRotationMatrix() *
      body.transpose());
  sample->quaternion = {converted.x(), converted.y(), converted.z(),
                        converted.w()};
}

// Yaw alone is that of the body's x axis.
absl::Status TurnYaw(const Conventions& conventions, Sample* sample) {
  double angle = conventions.body_yaw;
  if (conventions.body.has_value()) {
    const Eigen::Vector3d x = DirectionOf((*conventions.body)[0]);
    if (x.z() != 0.0) {
      return absl::InvalidArgumentError(
          "--body-axes with x up or down needs orientations as quaternions; "
          "the file has yaw alone");
    }
    angle += std::atan2(x.y(), x.x());
  }
  sample->estimate.heading -= angle;
  if (sample->truth.has_value()) sample->truth->heading -= angle;
  return absl::OkStatus();
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
  const bool turns_frame = !converted.geodetic.has_value() &&
                           (conventions.axes == Axes::kCamera ||
                            conventions.axes == Axes::kNorthEastDown);
  const bool turns_body =
      conventions.body.has_value() || conventions.body_yaw != 0.0;
  if (turns_frame && conventions.axes == Axes::kCamera) {
    if (absl::Status status = CheckForCamera(converted); !status.ok()) {
      return status;
    }
  }
  const Matrix3 frame =
      turns_frame ? FrameOf(conventions.axes) : Matrix3::Identity();
  if (turns_frame) TurnFrame(conventions.axes, frame, &converted);
  if (converted.quaternion.has_value()) {
    if (turns_frame || turns_body) {
      TurnOrientation(frame, BodyOf(conventions), &converted);
    }
  } else if (turns_body && converted.has_heading) {
    if (absl::Status status = TurnYaw(conventions, &converted); !status.ok()) {
      return status;
    }
  }
  if (converted.quaternion.has_value()) {
    converted.estimate.heading = HeadingOf(*converted.quaternion);
  }
  return converted;
}

std::optional<BodyAxes> ReadBodyAxes(std::string_view text) {
  if (text == "camera") text = "rdf";
  if (text.size() != 3) return std::nullopt;
  const BodyAxes body = {text[0], text[1], text[2]};
  // The columns of anything else are no rotation.
  if (MatrixOf(body).determinant() != 1.0) return std::nullopt;
  return body;
}

std::string Describe(const BodyAxes& body) {
  const auto word = [](char letter) {
    switch (letter) {
      case 'f':
        return "forward";
      case 'b':
        return "back";
      case 'l':
        return "left";
      case 'r':
        return "right";
      case 'u':
        return "up";
      default:
        return "down";
    }
  };
  return absl::StrCat("x points ", word(body[0]), ", y ", word(body[1]), ", z ",
                      word(body[2]));
}

std::array<double, 9> RotationOf(const Sample& sample) {
  const Matrix3 matrix =
      sample.quaternion.has_value()
          ? Rotation(*sample.quaternion).normalized().toRotationMatrix()
          : Eigen::AngleAxisd(sample.estimate.heading, Eigen::Vector3d::UnitZ())
                .toRotationMatrix();
  std::array<double, 9> rows;
  Eigen::Map<RowMajor3>(rows.data()) = matrix;
  return rows;
}

double HeadingOf(const std::array<double, 4>& quaternion) {
  const auto& [x, y, z, w] = quaternion;
  return std::atan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z);
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
