#include "core/graph/motion_statistics.h"

#include <Eigen/Eigenvalues>
#include <cassert>
#include <cmath>

namespace revisit::core {
namespace {

// R^T m R, with R the turn by `heading` about z.
template <int D>
StateMatrix<D> InVehicleAxes(const StateMatrix<D>& m, double heading) {
  StateMatrix<D> r = StateMatrix<D>::Identity();
  const double c = std::cos(heading);
  const double s = std::sin(heading);
  r(0, 0) = c;
  r(0, 1) = -s;
  r(1, 0) = s;
  r(1, 1) = c;
  return r.transpose() * m * r;
}

template <int D>
StateMatrix<D> WithoutNegativePart(const StateMatrix<D>& m) {
  if (!m.allFinite()) return StateMatrix<D>::Zero();
  const StateMatrix<D> symmetric = 0.5 * (m + m.transpose());
  const Eigen::SelfAdjointEigenSolver<StateMatrix<D>> solver(symmetric);
  const StateVector<D> kept = solver.eigenvalues().cwiseMax(0.0);
  return solver.eigenvectors() * kept.asDiagonal() *
         solver.eigenvectors().transpose();
}

}  // namespace

template <int D>
MotionStatistics<D> MeasureMotion(const PoseGraph& graph,
                                  CorrelationModel model, NodeIndex last) {
  assert(last < graph.size());
  MotionStatistics<D> statistics;
  StateMatrix<D> drift = StateMatrix<D>::Zero();
  StateMatrix<D> jitter = StateMatrix<D>::Zero();
  NodeIndex next_start = 0;
  for (NodeIndex i = 0; i <= last; ++i) {
    // Starts are few: looked up once a segment.
    if (i == next_start) {
      next_start = graph.SegmentEnd(i);
      continue;
    }
    const Pose& earlier = graph.node(i - 1).pose;
    const Pose& later = graph.node(i).pose;
    const double turn = Difference(later, earlier).heading;
    statistics.squared_turn += turn * turn;
    ++statistics.steps;
    const StateMatrix<D> covariance = ToMatrix<D>(graph.node(i).covariance);
    if (model == CorrelationModel::kIndependent) {
      jitter += InVehicleAxes<D>(covariance, later.heading);
      continue;
    }
    const StateMatrix<D> before = ToMatrix<D>(graph.node(i - 1).covariance);
    const StateMatrix<D> f = DeadReckoningTransition<D>(earlier, later);
    const StateMatrix<D> carried = f * before;
    StateMatrix<D> added = covariance;
    if (model == CorrelationModel::kDeadReckoning) {
      added -= carried * f.transpose();
    } else {
      const StateMatrix<D> psi = ToMatrix<D>(graph.transition(i));
      const StateMatrix<D> mixed = carried * psi.transpose();
      added += carried * f.transpose() - mixed - mixed.transpose();
    }
    drift += InVehicleAxes<D>(added, later.heading);
  }
  if (statistics.steps > 0) {
    const double count = static_cast<double>(statistics.steps);
    statistics.squared_turn /= count;
    statistics.drift = WithoutNegativePart<D>(drift / count);
    statistics.jitter = WithoutNegativePart<D>(jitter / count);
  }
  return statistics;
}

template MotionStatistics<3> MeasureMotion<3>(const PoseGraph&,
                                              CorrelationModel, NodeIndex);
template MotionStatistics<4> MeasureMotion<4>(const PoseGraph&,
                                              CorrelationModel, NodeIndex);

}  // namespace revisit::core
