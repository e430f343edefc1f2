#include "core/drive/confirmed_loop.h"

#include <cassert>
#include <cmath>

#include "core/drive/node_noise.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/covariances.h"
#include "core/noise/dead_reckoning.h"

namespace revisit::core {
namespace {

// The matched pose moved by the measurement.
Pose MovedPose(const MeasuredLoop& loop) {
  const Pose& from = loop.matched.pose;
  const Pose& by = loop.measurement.relative;
  const double c = std::cos(from.heading);
  const double s = std::sin(from.heading);
  return {from.x + c * by.x - s * by.y, from.y + s * by.x + c * by.y,
          from.z + by.z, WrapHeading(from.heading + by.heading)};
}

}  // namespace

Direction DirectionOf(const PoseGraph& graph, const ConfirmedLoop& loop) {
  const double turn =
      Difference(graph.pose(loop.query), graph.pose(loop.matched)).heading;
  return std::abs(turn) > 0.5 * kPi ? Direction::kOpposite : Direction::kSame;
}

template <int D>
PoseEstimate CarriedToQuery(const MeasuredLoop& loop) {
  const Pose moved = MovedPose(loop);
  const StateMatrix<D> lever =
      DeadReckoningTransition<D>(loop.matched.pose, moved);
  const StateMatrix<D> covariance =
      lever * ToMatrix<D>(loop.matched.covariance) * lever.transpose();
  return {moved, ToCovariance<D>(covariance)};
}

template <int D>
StateMatrix<D> MeasurementCovariance(const MeasuredLoop& loop) {
  return Turned<D>(ToMatrix<D>(loop.measurement.covariance),
                   loop.matched.pose.heading);
}

template <int D>
Innovation<D> InnovationOf(const PoseGraph& graph,
                           const Correlation& correlation,
                           const ConfirmedLoop& loop) {
  assert(loop.measured != nullptr && loop.matched <= loop.query);
  const MeasuredLoop& measured = *loop.measured;
  const PoseEstimate carried = CarriedToQuery<D>(measured);
  Innovation<D> innovation;
  innovation.difference =
      ToVector<D>(Difference(measured.query.pose, carried.pose));
  const NoiseModel& noise = correlation.noise();
  if (noise.has_closed_form()) {
    PathPair<D> pair;
    pair.earlier_pose = carried.pose;
    pair.later_pose = measured.query.pose;
    pair.earlier = ToMatrix<D>(carried.covariance);
    pair.later = ToMatrix<D>(measured.query.covariance);
    if (noise.decorrelates_over_way) {
      pair.meters_apart = graph.MetersApart(loop.query, loop.matched);
    }
    innovation.gamma = DifferenceCovariance<D>(correlation, pair);
    return innovation;
  }
  const StateMatrix<D> lever =
      DeadReckoningTransition<D>(measured.matched.pose, carried.pose);
  const StateMatrix<D> cross =
      CrossCovariance<D>(graph, correlation, loop.query, loop.matched) *
      lever.transpose();
  innovation.gamma =
      ToMatrix<D>(graph.covariance(loop.query)) +
      lever * ToMatrix<D>(graph.covariance(loop.matched)) * lever.transpose() -
      cross - cross.transpose();
  return innovation;
}

template PoseEstimate CarriedToQuery<3>(const MeasuredLoop&);
template PoseEstimate CarriedToQuery<4>(const MeasuredLoop&);
template StateMatrix<3> MeasurementCovariance<3>(const MeasuredLoop&);
template StateMatrix<4> MeasurementCovariance<4>(const MeasuredLoop&);
template Innovation<3> InnovationOf<3>(const PoseGraph&, const Correlation&,
                                       const ConfirmedLoop&);
template Innovation<4> InnovationOf<4>(const PoseGraph&, const Correlation&,
                                       const ConfirmedLoop&);

}  // namespace revisit::core
