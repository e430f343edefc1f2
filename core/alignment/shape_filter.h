// How far the shape of a path may stray from the shape it is compared with, and
// what it is worth that it does not.
//
// Two paths are walked back from their ends together, each seen from its own
// end pose. Their mismatch e_t = p'_t - q'_t is zero at the end. On the same
// road it drifts by what the odometry of both passes adds (a heading error
// swings what lies further back), and each node strays by a tolerance of its
// own:
//
//   drift_t = F_t drift_(t-1) + noise of two steps,  Cov(drift_0) = E_0
//   e_t = drift_t + straying,                        Cov(straying) = T + 2 J
//
// F_t is the lever arm of p's step, T the tolerance, J the jitter of one node
// (motion_statistics.h). drift_0 is how far the two end poses themselves stray:
// E_0 is 2 J and R, the place tolerance; of R in position no more than T, since
// another lane is the same offset all along. This is a Kalman filter whose
// covariances depend on p only: gains are computed once a query and shared by
// all of the history. With it runs its fixed-point smoother, which tells
// drift_0 from what came after: so the ends are compared by the whole path and
// not by two poses.
//
// What a match is worth depends on how rare the shape is. Another road would
// turn as p does by chance: about as often as the vehicle's own roads do. The
// log-likelihood ratio of same road against another is, for each step,
//
//   -ln(share of own stretches that turn as p does around t) - 1/2 nu^T S^-1 nu
//
// with nu the innovation and S its covariance: a straight gains next to
// nothing, a corner much, and a mismatch costs the same on both.
//
// Neighbouring nodes stray together. Sums over steps are therefore weighed by
// w = node spacing / correlation distance, and so is the information that the
// smoother has gathered; stretches are as long as the correlation distance.
//
// Kalman filter and fixed-point smoother: Anderson, Moore, "Optimal Filtering"
// (1979), 3.1 and 7.2.
#ifndef REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
#define REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/alignment/log_similarity.h"
#include "core/alignment/walk_kernel.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/graph/correlation.h"
#include "core/graph/motion_history.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

struct ShapeModel {
  // Standard deviations at each node, beside the drift: position [0.01, 1000]
  // m, heading [0.001, 3] rad.
  PlaceTolerance tolerance{1.0, 0.06};
  // Distance over which that straying is one and the same, [0.01, 1e6] m.
  double correlation_meters = 10.0;
};

// Least noise of odometry, whatever the covariances claim: those of an
// optimiser, or constant ones, say nothing of a single step. Standard
// deviations per square root of a metre.
inline constexpr double kLeastStepNoiseMeters = 0.02;
inline constexpr double kLeastStepNoiseRadians = 0.0005;

// Stretches whose turns are compared: as long as the correlation distance, but
// no longer than a path of `steps` nodes, so that like is compared with like.
NodeIndex StretchNodes(const ShapeModel& model, double spacing_meters,
                       std::int64_t steps);

// w, at most 1.
double ShapeWeight(const ShapeModel& model, double spacing_meters);

template <int D>
class ShapeFilter {
 public:
  // What the filter knows of one other path.
  struct Drift {
    StateVector<D> now = StateVector<D>::Zero();
    // drift_0, in the axes of the vehicle at the end of the path.
    StateVector<D> at_end = StateVector<D>::Zero();
  };
  // What one step brought.
  struct Evidence {
    // nu^T S^-1 nu
    double squared_innovation = 0.0;
    double log_likelihood_ratio = 0.0;
  };

  // The path of `steps` nodes that ends at `query`, within one segment.
  // `inflation` multiplies the standard deviations of the nodes' motion under
  // this correlation model. `history`, if there is one, is that of the graph;
  // what it does not know is measured.
  ShapeFilter(const PoseGraph& graph, const MotionHistory* history,
              NodeIndex query, std::int64_t steps, CorrelationModel correlation,
              const ShapeModel& model, const PlaceTolerance& place_tolerance,
              double spacing_meters, double inflation);

  // Nodes of the path.
  std::int64_t size() const { return static_cast<std::int64_t>(steps_.size()); }

  // Carries the drift from step t - 1 to t in [1, size()), where the other path
  // is at `other`, seen from its own end.
  Evidence Advance(std::int64_t t, const StateVector<D>& other,
                   Drift* drift) const {
    const Step& step = steps_[static_cast<std::size_t>(t)];
    StateVector<D> now = drift->now;
    const double turn = now(D - 1);
    now(0) -= step.step_y * turn;
    now(1) += step.step_x * turn;
    StateVector<D> innovation = step.path - other - now;
    innovation(D - 1) = WrapHeading(innovation(D - 1));
    const double squared = innovation.dot(step.information * innovation);
    drift->now.noalias() = now + step.gain * innovation;
    drift->at_end.noalias() += step.end_gain * innovation;
    return {squared, step.surprise - 0.5 * squared};
  }

  // The step as the kernel takes it; `to_come` and `settled` are the caller's.
  WalkStep Kernel(std::int64_t t) const;

  // A shift of at_end has at least s^T EndShift()^-1 s of squared innovations.
  const StateMatrix<D>& EndShift() const { return end_shift_; }

  // By how much the covariance of drift_0 has shrunk after step t, in the same
  // axes.
  const StateMatrix<D>& EndCertainty(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)].end_certainty;
  }

 private:
  struct Step {
    // Seen from the end.
    StateVector<D> path;
    // From the node after it.
    double step_x = 0.0;
    double step_y = 0.0;
    StateMatrix<D> gain;
    StateMatrix<D> end_gain;
    // S^-1
    StateMatrix<D> information;
    double surprise = 0.0;
    StateMatrix<D> end_certainty;
  };

  std::vector<Step> steps_;
  StateMatrix<D> end_shift_ = StateMatrix<D>::Zero();
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
