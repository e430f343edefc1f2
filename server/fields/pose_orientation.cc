#include "server/fields/pose_orientation.h"

#include <cmath>

#include "server/fields/geodetic_frame.h"

namespace revisit::server {
namespace {

constexpr double kMaxNormError = 1e-3;

}  // namespace

double NormOf(const Quaternion& quaternion) {
  const auto [x, y, z, w] = quaternion;
  return std::hypot(std::hypot(x, y), std::hypot(z, w));
}

bool IsUnit(double norm) { return std::abs(norm - 1.0) <= kMaxNormError; }

std::optional<Forward> ForwardOf(const Quaternion& quaternion, double norm) {
  auto [x, y, z, w] = quaternion;
  x /= norm;
  y /= norm;
  z /= norm;
  w /= norm;
  Forward forward;
  forward.axis = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z),
                  2.0 * (x * z - w * y)};
  if (std::hypot(forward.axis[0], forward.axis[1]) <= kMinHorizontal) {
    return std::nullopt;
  }
  forward.heading = std::atan2(forward.axis[1], forward.axis[0]);
  return forward;
}

}  // namespace revisit::server
