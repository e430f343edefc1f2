#include "server/fleet/fix_datums.h"

#include <cmath>

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "server/fields/geodetic_frame.h"

namespace revisit::server {
namespace {

// No caller's datum can have this name, since names hold no control characters.
constexpr char kFixesDatumId[] =
    "\x01"
    "fixes";
// Squares of metres and radians in which nothing is known exactly.
constexpr double kNegligible = 1e-12;

core::StateMatrix<4> TurnBy(double heading) {
  core::StateMatrix<4> turn = core::StateMatrix<4>::Identity();
  turn(0, 0) = std::cos(heading);
  turn(0, 1) = -std::sin(heading);
  turn(1, 0) = std::sin(heading);
  turn(1, 1) = std::cos(heading);
  return turn;
}

}  // namespace

std::shared_ptr<const core::RecordingStart> DatumOfFixes(
    const GeodeticOrigin& anchor, const GeodeticOrigin& origin,
    double bias_meters, core::StateSpace space,
    const std::optional<core::Covariance>& first_error) {
  core::PoseSample east;
  GeodeticFrame(anchor).ToLocal(origin, {1.0, 0.0, 0.0}, space, &east);
  if (space == core::StateSpace::kPlanar) east.pose.z = 0.0;
  auto start = std::make_shared<core::RecordingStart>();
  start->relation = core::RecordingRelation::kDatum;
  start->datum = east.pose;
  if (bias_meters == 0.0 && !first_error) start->datum_id = kFixesDatumId;
  core::StateMatrix<4> error = core::StateMatrix<4>::Zero();
  if (first_error) {
    const core::StateMatrix<4> turn = TurnBy(start->datum.heading);
    error = turn * core::ToMatrix<4>(*first_error) * turn.transpose();
  }
  for (int i = 0; i < 3; ++i) error(i, i) += bias_meters * bias_meters;
  error.diagonal().array() += kNegligible;
  start->covariance = core::ToCovariance<4>(error);
  return start;
}

}  // namespace revisit::server
