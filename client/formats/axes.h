// The conventions of a file: which way its axes point, those of the frame and
// those of the body, in what its angles are counted, and in which order it
// writes quaternions.
#ifndef REVISIT_CLIENT_FORMATS_AXES_H_
#define REVISIT_CLIENT_FORMATS_AXES_H_

#include <array>
#include <optional>
#include <string>
#include <string_view>

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

// Which way the body's x, y and z point in the vehicle, a letter each: f, b, l,
// r, u and d for forward, back, left, right, up and down. Right-handed.
using BodyAxes = std::array<char, 3>;

// Reads "rfu", or "camera" for "rdf"; absent if they are no right-handed axes.
std::optional<BodyAxes> ReadBodyAxes(std::string_view text);

// "x points right, y forward, z up".
std::string Describe(const BodyAxes& body);

struct Conventions {
  // The axes of the frame and, where `body` is absent, of the body.
  Axes axes = Axes::kForwardLeftUp;
  std::optional<BodyAxes> body;
  // How far the body is turned to the left of the vehicle, in radians: what the
  // heading of a sensor exceeds the vehicle's by.
  double body_yaw = 0.0;
  Angles angles = Angles::kRadians;
  QuaternionOrder quaternion = QuaternionOrder::kXyzw;
};

// Converts a sample as a file has it: position, orientation, covariance, error
// transition and truth together. Sets `estimate.heading` from a quaternion.
// INVALID_ARGUMENT, without a place, if axes cannot be converted for lack of
// full orientations and covariances. The frame of geodetic samples has no axes
// of its own; only their angles and their body's axes are converted.
absl::StatusOr<Sample> Convert(const Sample& sample,
                               const Conventions& conventions);

// The rotation of the body's axes into those of the frame, by rows, both as the
// file has them; about z alone where the sample has yaw alone.
std::array<double, 9> RotationOf(const Sample& sample);

// The direction of the body's x axis in the x-y plane of the frame, in radians,
// by a quaternion (x, y, z, w).
double HeadingOf(const std::array<double, 4>& quaternion);

// Cosine of the angle between the body's up axis and z; 1 without a quaternion.
double UprightCosine(const Sample& sample);

// The quaternion (x, y, z, w) of a rotation matrix by rows; absent if the rows
// are not orthonormal to 1e-2 or form a reflection.
std::optional<std::array<double, 4>> QuaternionOf(
    const std::array<double, 9>& rotation);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_AXES_H_
