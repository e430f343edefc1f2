// What a vehicle's own nodes say of its estimator and of its roads: the noise
// of one step between consecutive nodes, and how much the roads bend.
#ifndef REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_
#define REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/geometry/heading.h"
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
// part. O(last).
template <int D>
MotionStatistics<D> MeasureMotion(const PoseGraph& graph,
                                  CorrelationModel model, NodeIndex last);

// What MotionStatistics are the means of.
template <int D>
struct MotionSums {
  std::int64_t steps = 0;
  // Of jitter for kIndependent, of drift for the others.
  StateMatrix<D> sum = StateMatrix<D>::Zero();
};

// Adds the steps that lead to nodes [first, end), one after the other: sums
// come out the same, to the last bit, however often they were put aside.
template <int D>
void AddMotion(const PoseGraph& graph, CorrelationModel model, NodeIndex first,
               NodeIndex end, MotionSums<D>* sums);

template <int D>
MotionStatistics<D> MeanMotion(CorrelationModel model,
                               const MotionSums<D>& sums);

// How common turns are among the vehicle's own: for each of the turns given
// (rad), the share of all stretches of `stretch_nodes` steps within nodes [0,
// last] that turn by as much to within `tolerance_radians`, with one more that
// does, so that it is never 0. O(last log(turns)).
std::vector<double> ShareOfStretches(const PoseGraph& graph, NodeIndex last,
                                     NodeIndex stretch_nodes,
                                     const std::vector<double>& turns,
                                     double tolerance_radians);

// Calls visit(turn) for every stretch whose last node is in [first, end).
// Stretches lie within one segment.
template <typename Visit>
void VisitStretches(const PoseGraph& graph, NodeIndex stretch_nodes,
                    NodeIndex first, NodeIndex end, const Visit& visit) {
  while (first < end) {
    const NodeIndex segment_end = std::min(graph.SegmentEnd(first), end);
    for (NodeIndex i =
             std::max(first, graph.SegmentStart(first) + stretch_nodes);
         i < segment_end; ++i) {
      visit(WrapHeading(graph.pose(i).heading -
                        graph.pose(i - stretch_nodes).heading));
    }
    first = segment_end;
  }
}

// Counts stretches for ShareOfStretches().
class StretchCounter {
 public:
  StretchCounter(const std::vector<double>& turns, double tolerance_radians);

  // A stretch, or one less. O(log(turns)).
  void Add(double turn, std::int64_t times = 1);
  // Many, sorted. O(turns log(stretches)).
  void AddSorted(const std::vector<double>& stretches);

  std::vector<double> Shares() const;

 private:
  // Bounds that are at most this turn.
  std::size_t BoundsUpTo(double turn) const;

  std::vector<double> turns_;
  double tolerance_radians_;
  // Of what counts for each turn, sorted: between two neighbouring ones, all
  // stretches count for the same turns.
  std::vector<double> bounds_;
  // Stretches that lie beyond as many bounds, from Add().
  std::vector<std::int64_t> beyond_;
  // Stretches below each bound, from AddSorted().
  std::vector<std::int64_t> below_;
  std::int64_t stretches_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_GRAPH_MOTION_STATISTICS_H_
