// Angles in radians.
#ifndef REVISIT_CLIENT_FORMATS_ANGLES_H_
#define REVISIT_CLIENT_FORMATS_ANGLES_H_

namespace revisit::client {

inline constexpr double kPi = 3.14159265358979323846;
inline constexpr double kRadiansPerDegree = kPi / 180.0;
// A whole turn.
inline constexpr double kTurn = 2.0 * kPi;

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_ANGLES_H_
