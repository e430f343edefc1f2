#include "core/graph/motion_statistics.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <numeric>

#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

// R^T m R, with R the turn by `heading` about z.
template <int D>
StateMatrix<D> InVehicleAxes(const StateMatrix<D>& m, double heading) {
  const StateMatrix<D> r = TurnAbout<D>(heading);
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
    const Pose earlier = graph.node(i - 1).pose;
    const Pose later = graph.node(i).pose;
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
    statistics.drift = WithoutNegativePart<D>(drift / count);
    statistics.jitter = WithoutNegativePart<D>(jitter / count);
  }
  return statistics;
}

std::vector<double> ShareOfStretches(const PoseGraph& graph, NodeIndex last,
                                     NodeIndex stretch_nodes,
                                     const std::vector<double>& turns,
                                     double tolerance_radians) {
  assert(last < graph.size() && stretch_nodes >= 1);
  // Between two neighbouring bounds, all stretches count for the same turns.
  std::vector<double> bounds;
  for (const double turn : turns) {
    bounds.push_back(turn - tolerance_radians);
    bounds.push_back(turn + tolerance_radians);
  }
  std::sort(bounds.begin(), bounds.end());
  const auto bin = [&bounds](double turn) {
    return static_cast<std::size_t>(
        std::upper_bound(bounds.begin(), bounds.end(), turn) - bounds.begin());
  };
  std::vector<std::int64_t> counts(bounds.size() + 1);
  std::int64_t stretches = 0;
  for (NodeIndex start = 0; start <= last;) {
    const NodeIndex end = std::min(graph.SegmentEnd(start), last + 1);
    for (NodeIndex i = start + stretch_nodes; i < end; ++i) {
      ++counts[bin(
          Difference(graph.node(i).pose, graph.node(i - stretch_nodes).pose)
              .heading)];
      ++stretches;
    }
    start = end;
  }
  // Stretches below each bound.
  std::partial_sum(counts.begin(), counts.end(), counts.begin());
  std::vector<double> shares;
  for (const double turn : turns) {
    const std::int64_t within = counts[bin(turn + tolerance_radians) - 1] -
                                counts[bin(turn - tolerance_radians) - 1];
    shares.push_back((1.0 + static_cast<double>(within)) /
                     (1.0 + static_cast<double>(stretches)));
  }
  return shares;
}

template MotionStatistics<3> MeasureMotion<3>(const PoseGraph&,
                                              CorrelationModel, NodeIndex);
template MotionStatistics<4> MeasureMotion<4>(const PoseGraph&,
                                              CorrelationModel, NodeIndex);

}  // namespace revisit::core
