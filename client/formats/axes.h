// The conventions of a file: which way its axes point, in what its angles are
// counted, and in which order it writes quaternions.
#ifndef REVISIT_CLIENT_FORMATS_AXES_H_
#define REVISIT_CLIENT_FORMATS_AXES_H_

#include <array>
#include <optional>

#include "absl/status/statusor.h"
#include "client/formats/sample.h"

namespace revisit::client {

// Axes of the frame that positions are in, and of the body.
enum class Axes {
  // z up; the body's x forward, y left. What the service takes.
  kForwardLeftUp,
  // Both as of a camera: x right, y down, z forward (KITTI, ORB-SLAM).
  kCamera,
  // x north, y east, z down; the body's x forward, y right. Yaw is clockwise
  // from north.
  kNorthEastDown,
  // x east, y north, z up; the body's x forward, y left. Yaw is
  // counter-clockwise from east: other words for kForwardLeftUp.
  kEastNorthUp,
};

// How yaw is counted; covariances and transitions of yaw likewise.
enum class Angles {
  kRadians,
  kDegrees,
  // Clockwise from the y axis (north).
  kCompassRadians,
  kCompassDegrees,
};

enum class QuaternionOrder { kXyzw, kWxyz };

struct Conventions {
  Axes axes = Axes::kForwardLeftUp;
  Angles angles = Angles::kRadians;
  QuaternionOrder quaternion = QuaternionOrder::kXyzw;
};

// Converts a sample as a file has it: position, orientation, covariance, error
// transition and truth together. Sets `estimate.heading` from a quaternion.
// INVALID_ARGUMENT, without a place, if the camera's axes cannot be converted
// for lack of full orientations and covariances. Geodetic samples have no axes
// of their own; only their angles are converted.
absl::StatusOr<Sample> Convert(const Sample& sample,
                               const Conventions& conventions);

// Cosine of the angle between the body's up axis and z; 1 without a quaternion.
double UprightCosine(const Sample& sample);

// The quaternion (x, y, z, w) of a rotation matrix by rows; absent if the rows
// are not orthonormal to 1e-2 or form a reflection.
std::optional<std::array<double, 4>> QuaternionOf(
    const std::array<double, 9>& rotation);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_AXES_H_
