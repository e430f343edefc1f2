// Orientations that are quaternions: where they point.
#ifndef REVISIT_SERVER_FIELDS_POSE_ORIENTATION_H_
#define REVISIT_SERVER_FIELDS_POSE_ORIENTATION_H_

#include <array>
#include <optional>

namespace revisit::server {

// The forward axis of a vehicle in the axes of its position, and its heading.
struct Forward {
  double heading = 0.0;
  std::array<double, 3> axis{};
};

// A quaternion is x, y, z, w.
using Quaternion = std::array<double, 4>;

double NormOf(const Quaternion& quaternion);
// Whether a quaternion of this norm is one of a pose.
bool IsUnit(double norm);
// Nothing if the axis points straight up or down, and has no heading. REQUIRES:
// finite numbers, whose norm is this one, and IsUnit().
std::optional<Forward> ForwardOf(const Quaternion& quaternion, double norm);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_POSE_ORIENTATION_H_
