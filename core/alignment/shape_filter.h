// How far the shape of a path may stray from the shape it is compared with, and
// how likely what is seen is on the same road and on another.
//
// Two paths are walked back from their ends together, each seen from its own end
// pose. Their mismatch e_t = p'_t - q'_t is zero at the end. On the same road it
// drifts by what the odometry of both passes adds (a heading error swings what
// lies further back), and each node strays by a tolerance of its own:
//
//   drift_t = F_t drift_(t-1) + noise of two steps,  Cov(drift_0) = T + 2 J
//   e_t = drift_t + straying,                        Cov(straying) = T + 2 J
//
// with F_t the lever arm of p's step, T the tolerance and J the jitter of one
// node (motion_statistics.h). This is a Kalman filter whose covariances depend on
// p only: gains are computed once a query and shared by all of the history. On
// another road the heading also turns as the vehicle's roads do, for each of the
// two paths. The difference of the two log densities is the log-likelihood ratio
// of one step.
//
// Kalman filter, innovation and its covariance: Bar-Shalom, Li, Kirubarajan,
// "Estimation with Applications to Tracking and Navigation" (2001), 5.2.
#ifndef REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
#define REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/alignment/log_similarity.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/graph/motion_statistics.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// What the roads are taken for. Standard deviations, never zero.
struct ShapeModel {
  // At each node, beside the drift: position [0.01, 1000] m, heading
  // [0.001, 3] rad. Default: half the place tolerance, since most of a lane's
  // offset is the same at the end and along the way.
  PlaceTolerance tolerance{1.0, 0.06};
  // Distance over which that straying is one and the same, [0.01, 1e6] m: nodes
  // closer than this are not independent witnesses.
  double correlation_meters = 10.0;
};

// Least noise of one metre of odometry, whatever the covariances claim: those of
// an optimiser, or constant ones, say nothing of a single step. Standard
// deviations per square root of a metre.
inline constexpr double kLeastStepNoiseMeters = 0.02;
inline constexpr double kLeastStepNoiseRadians = 0.0005;

// Innovations beyond this squared Mahalanobis distance end the overlap of two
// paths: chi-square with 3 degrees of freedom exceeds it once in 900 steps.
inline constexpr double kSquaredInnovationLimit = 16.0;

template <int D>
class ShapeFilter {
 public:
  // The drift of one candidate, under both hypotheses. Zero at the end.
  struct Drift {
    StateVector<D> same_road = StateVector<D>::Zero();
    StateVector<D> other_road = StateVector<D>::Zero();
  };
  // What one step brought.
  struct Evidence {
    // Squared Mahalanobis distance of the innovation on the same road.
    double squared_innovation = 0.0;
    double log_likelihood_ratio = 0.0;
  };

  // The path of `steps` nodes that ends at `query`, within one segment.
  // `inflation` multiplies the standard deviations of drift and jitter.
  ShapeFilter(const PoseGraph& graph, NodeIndex query, std::int64_t steps,
              const MotionStatistics<D>& motion, const ShapeModel& model,
              double spacing_meters, double inflation);

  // Nodes of the path.
  std::int64_t size() const { return static_cast<std::int64_t>(steps_.size()); }

  // Node t of the path back from its end, seen from its end.
  const StateVector<D>& path(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)].path;
  }

  // Carries the drift from step t - 1 to t in [1, size()), where the other path
  // is at `other`, seen from its own end.
  Evidence Advance(std::int64_t t, const StateVector<D>& other,
                   Drift* drift) const {
    const Step& step = steps_[static_cast<std::size_t>(t)];
    const StateVector<D> mismatch = step.path - other;
    const double same = Update(step, step.same_road, mismatch,
                               &drift->same_road);
    const double another = Update(step, step.other_road, mismatch,
                                  &drift->other_road);
    return {same, 0.5 * (another - same) + step.log_determinants};
  }

 private:
  struct Hypothesis {
    StateMatrix<D> gain;
    // Inverse covariance of the innovation.
    StateMatrix<D> information;
  };
  struct Step {
    StateVector<D> path;
    // From the node after it.
    double step_x = 0.0;
    double step_y = 0.0;
    Hypothesis same_road;
    Hypothesis other_road;
    // Half of ln|S| of the other road less that of the same.
    double log_determinants = 0.0;
  };

  // Predicts and corrects; the innovation's squared Mahalanobis distance.
  static double Update(const Step& step, const Hypothesis& hypothesis,
                       const StateVector<D>& mismatch, StateVector<D>* drift) {
    const double turn = (*drift)(D - 1);
    (*drift)(0) -= step.step_y * turn;
    (*drift)(1) += step.step_x * turn;
    StateVector<D> innovation = mismatch - *drift;
    innovation(D - 1) = WrapHeading(innovation(D - 1));
    *drift += hypothesis.gain * innovation;
    return innovation.dot(hypothesis.information * innovation);
  }

  std::vector<Step> steps_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
