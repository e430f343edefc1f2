// Angles in the plane. Radians, counter-clockwise from +x.
#ifndef REVISIT_CORE_GEOMETRY_HEADING_H_
#define REVISIT_CORE_GEOMETRY_HEADING_H_

#include <cmath>

namespace revisit::core {

inline constexpr double kPi = 3.14159265358979323846;

// The angle, wrapped to (-pi, pi].
inline double WrapHeading(double angle) {
  if (angle > -kPi && angle <= kPi) return angle;
  // remainder() rounds half-way cases to even, so -pi can come out; the
  // interval is open there.
  const double wrapped = std::remainder(angle, 2.0 * kPi);
  return wrapped <= -kPi ? kPi : wrapped;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_HEADING_H_
