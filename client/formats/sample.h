// One pose of a recording, as the readers of files hand it on.
#ifndef REVISIT_CLIENT_FORMATS_SAMPLE_H_
#define REVISIT_CLIENT_FORMATS_SAMPLE_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>

#include "client/formats/geodetic.h"

namespace revisit::client {

// Metres, and radians counter-clockwise from +x.
struct PlanarPose {
  double x = 0.0;
  double y = 0.0;
  double heading = 0.0;
};

// Metres per second to the east and north, or along x and y.
struct Velocity {
  double east = 0.0;
  double north = 0.0;
  // ee, en, nn.
  std::optional<std::array<double, 3>> covariance;
};

struct Sample {
  // Since the Unix epoch, or since a start of the file's own.
  std::optional<std::int64_t> time_nanoseconds;
  // Local position and heading. Where there is a geodetic position, x and y are
  // metres to the east and north of the file's first one.
  PlanarPose estimate;
  double z = 0.0;
  // Whether the file says where the vehicle faces; `estimate.heading` and
  // `quaternion` mean nothing otherwise.
  bool has_heading = true;
  // Rotation of the body (forward, left, up) as x, y, z, w; the heading is
  // that of the rotated forward axis.
  std::optional<std::array<double, 4>> quaternion;
  // Sent in place of the local position.
  std::optional<GeodeticPosition> geodetic;
  std::optional<Velocity> velocity;
  // The covariance of a position alone: xx, xy, yy.
  std::optional<std::array<double, 3>> position_covariance;
  // The entries of a position's covariance that concern height: xz, yz, zz.
  std::optional<std::array<double, 3>> height_covariance;
  // The variance of a heading that was taken from the course.
  std::optional<double> heading_variance;
  // The covariance of the planar pose: xx, xy, xh, yy, yh, hh.
  std::optional<std::array<double, 6>> covariance;
  // Row-major, of x, y, z and rotations about these fixed axes. Where it is
  // there, `covariance` is its part of x, y and heading.
  std::optional<std::array<double, 36>> covariance_36;
  // v1::Pose.error_transition of a planar vehicle.
  std::optional<std::array<double, 9>> error_transition;
  // Whether an odometry began anew here, in a frame of its own.
  bool restarts = false;
  // A revisit.v1.RecordingStart as JSON, where the file says that a recording
  // begins here (plain_readers.h).
  std::optional<std::string> recording_start;
  std::optional<PlanarPose> truth;
  // The height of the truth.
  std::optional<double> truth_z;
  // The line of the file where it ends; 0 if it was not read from a line.
  std::int64_t line = 0;
};

// The planar part of a covariance of 36 numbers.
inline std::array<double, 6> PlanarPart(const std::array<double, 36>& c) {
  return {c[0], c[1], c[5], c[7], c[11], c[35]};
}

// Seconds, as near as a double comes; 0 without a time.
inline double SecondsOf(const Sample& sample) {
  return static_cast<double>(sample.time_nanoseconds.value_or(0)) * 1e-9;
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_SAMPLE_H_
