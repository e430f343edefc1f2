// Statistics of a vehicle's own nodes: the noise that its estimator adds in one
// step between consecutive nodes, and how much its roads bend.
#ifndef REVISIT_CORE_DRIVE_MOTION_STATISTICS_H_
#define REVISIT_CORE_DRIVE_MOTION_STATISTICS_H_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// Means over the steps from one node to the next, without jumps. What a step
// adds, the noise model says (OfStep() in core/noise).
template <int D>
struct MotionStatistics : StepNoise<D> {
  std::int64_t steps = 0;
};

// The sums that MotionStatistics are the means of.
template <int D>
struct MotionSums {
  std::int64_t steps = 0;
  // Sum of drift and jitter (StepCovariance()).
  StateMatrix<D> sum = StateMatrix<D>::Zero();
};

// Adds the steps that lead to nodes [first, end), in order: a sum that is built
// by several calls equals that of a single call to the last bit.
template <int D>
void AddMotion(const PoseGraph& graph, const Correlation& correlation,
               NodeIndex first, NodeIndex end, MotionSums<D>* sums);

// Both covariances are positive semidefinite: a mean that rounding,
// interpolation or an optimiser has made indefinite loses its negative part.
template <int D>
MotionStatistics<D> MeanMotion(const Correlation& correlation,
                               const MotionSums<D>& sums);

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

// Counts stretches to tell how common turns are: for each given turn (rad), the
// share of the stretches that turn by as much to within `tolerance_radians`.
// One stretch that does is added to all, so that no share is 0.
class StretchCounter {
 public:
  StretchCounter(const std::vector<double>& turns, double tolerance_radians);

  // Counts a stretch `times` times; -1 takes it back out. O(log(turns)).
  void Add(double turn, std::int64_t times = 1);
  // Counts many stretches, which are sorted. O(turns log(stretches)).
  void AddSorted(const std::vector<double>& stretches, std::int64_t times = 1);

  std::vector<double> Shares() const;

 private:
  // Number of bounds that are at most this turn.
  std::size_t BoundsUpTo(double turn) const;

  std::vector<double> turns_;
  double tolerance_radians_;
  // Least and greatest stretch that counts for each turn, all sorted: between
  // two neighbouring bounds, all stretches count for the same turns.
  std::vector<double> bounds_;
  // Entry n is the number of stretches from Add() with BoundsUpTo() n.
  std::vector<std::int64_t> beyond_;
  // Number of stretches from AddSorted() below each bound.
  std::vector<std::int64_t> below_;
  std::int64_t stretches_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_MOTION_STATISTICS_H_
