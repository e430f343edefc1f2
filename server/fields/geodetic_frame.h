// Geodetic poses in the local frame of their vehicle.
//
// The local frame of a geodetic vehicle is East-North-Up at its origin. With M
// the rotation from East-North-Up at the pose to that frame (the two differ by
// the curvature of the earth):
//   * the position is the pose's, in the local frame;
//   * the heading is that of M f projected onto the local x-y plane, f being
//   the
//     forward axis at the pose;
//   * the covariance is carried over by the Jacobian J of these two maps, which
//     is M for position (PLANAR: its upper left 2x2 part, since nothing is
//     known of height) and, for heading, the derivative of the heading of M f
//     by a turn of f about the vertical at the pose;
//   * an error transition Psi becomes J Psi J^-1: consecutive poses are so
//   close
//     that their frames are taken for one.
#ifndef REVISIT_SERVER_FIELDS_GEODETIC_FRAME_H_
#define REVISIT_SERVER_FIELDS_GEODETIC_FRAME_H_

#include <GeographicLib/LocalCartesian.hpp>
#include <array>
#include <vector>

#include "core/geometry/pose.h"
#include "core/settings.h"
#include "server/fields/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// An axis whose projection onto the ground is no longer than this has no
// heading.
inline constexpr double kMinHorizontal = 1e-6;

// Adds violations for what is not finite or not on the earth.
void CheckGeodetic(const GeodeticOrigin& position, const FieldPath& path,
                   Violations* violations);

// Thread-compatible.
class GeodeticFrame {
 public:
  explicit GeodeticFrame(const GeodeticOrigin& origin);

  const GeodeticOrigin& origin() const { return origin_; }

  // Sets the sample's position and heading, and turns its covariance and
  // transition, which are given in East-North-Up at the position. False if the
  // forward axis has no heading in the local frame.
  bool ToLocal(const GeodeticOrigin& position,
               const std::array<double, 3>& forward, core::StateSpace space,
               core::PoseSample* sample);

 private:
  const GeodeticOrigin origin_;
  const GeographicLib::LocalCartesian frame_;
  // M, row-major 3x3; a member so that its memory is used again.
  std::vector<double> rotation_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_GEODETIC_FRAME_H_
