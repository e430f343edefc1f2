// What a vehicle's own nodes say of its estimator and of its roads: the noise
// of one step between consecutive nodes, and how much the roads bend.
#ifndef REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_
#define REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_

#include <cstdint>
#include <vector>

#include "core/geometry/pose.h"
#include "core/graph/correlation.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Means over the steps from one node to the next, jumps left out. Axes of the
// vehicle at the later node: x forward, y left, z up.
template <int D>
struct MotionStatistics {
  std::int64_t steps = 0;
  // Covariance of what one step adds to the error, Cov(e_i - F e_(i-1)) with F
  // the transition of dead reckoning: grows with distance. With Psi the model's
  // transition it is
  //
  //   S_i + F S_(i-1) F^T - Psi S_(i-1) F^T - F S_(i-1) Psi^T.
  //
  // Zero for kIndependent, whose errors do not grow but start anew.
  StateMatrix<D> drift = StateMatrix<D>::Zero();
  // Covariance of the error that each node has for itself: S_i for
  // kIndependent, else zero.
  StateMatrix<D> jitter = StateMatrix<D>::Zero();
};

// Over nodes [0, last]. Both covariances are positive semidefinite: means that
// rounding, interpolation or an optimiser made indefinite lose their negative
// part.
template <int D>
MotionStatistics<D> MeasureMotion(const PoseGraph& graph,
                                  CorrelationModel model, NodeIndex last);

// How common turns are among the vehicle's own: for each of the turns given
// (rad), the share of all stretches of `stretch_nodes` steps within nodes [0,
// last] that turn by as much to within `tolerance_radians`, with one more that
// does, so that it is never 0. O(last log(turns)).
std::vector<double> ShareOfStretches(const PoseGraph& graph, NodeIndex last,
                                     NodeIndex stretch_nodes,
                                     const std::vector<double>& turns,
                                     double tolerance_radians);

}  // namespace revisit::core

#endif  // REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_
