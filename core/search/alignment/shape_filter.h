// How far the shape of a path may stray from the shape it is compared with, and
// how much a match of the two is worth.
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
// E_0 is 2 J plus the place tolerance R; in position, R counts no more than T,
// since another lane is at the same offset all along. This is a Kalman filter
// whose covariances depend on p only: gains are computed once per query and
// shared by all of the history. With it runs its fixed-point smoother, which
// estimates drift_0 from all later steps: so the ends are compared by the whole
// path and not by two poses.
//
// A match is worth the more, the rarer the shape is. Another road would turn as
// p does by chance, about as often as the vehicle's own roads do. For each
// step, the log-likelihood ratio of the same road against another is
//
//   -ln P(turn of p around t | turn of p right after it) - 1/2 nu^T S^-1 nu
//
// with nu the innovation, S its covariance, and P counted over the vehicle's
// own stretches (turn_pairs.h), and over those of all other drives that are
// searched; where headings jitter, whatever the turn after.
// A straight gains next to nothing and a corner much, unless corners follow
// each other everywhere, as in a grid; a mismatch costs the same on all.
//
// A path of the history that ends before the recent one does says that the two
// roads join there, which costs kJoinCost: of all the lengths that a path could
// have, the best is taken. The ratio of the last step has as much more, so that
// the path which is never left costs nothing.
//
// Neighbouring nodes stray together. Sums over steps are therefore weighted by
// w = node spacing / correlation distance, and so is the information that the
// smoother has gathered. Stretches are as long as the correlation distance.
//
// Kalman filter and fixed-point smoother: Anderson, Moore, "Optimal Filtering"
// (1979), 3.1 and 7.2.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SHAPE_FILTER_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SHAPE_FILTER_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/walk_kernel.h"
#include "core/settings.h"

namespace revisit::core {

// Least noise of odometry, whatever the covariances claim: the covariances of
// an optimiser, or constant ones, say nothing about a single step. Standard
// deviations of both passes together, per square root of a metre.
inline constexpr PlaceTolerance kLeastStepNoise{0.02, 0.0005};

// The most of it where covariances have a margin for how the drift of a whole
// drive adds up (NoiseModel::has_margin_per_step): step by step, odometers of
// road vehicles are better than that.
inline constexpr PlaceTolerance kMostStepNoise{0.053, 0.0013};

// Cost of the place at which two roads join, nats: a prior of e^-1.5 for each
// stretch at which they may. Without it, the mean of e^(w ratio) over nodes of
// other roads is above 20, where that of an honest ratio is 1
// (tests/evaluation/RESULTS.md).
inline constexpr double kJoinCost = 1.5;

// The weight w, at most 1.
double ShapeWeight(const ShapeModel& model, double spacing_meters);

template <int D>
class ShapeFilter {
 public:
  // The filter's estimates for one other path.
  struct Drift {
    StateVector<D> now = StateVector<D>::Zero();
    // drift_0, in the axes of the vehicle at the end of the path.
    StateVector<D> at_end = StateVector<D>::Zero();
  };
  // The outcome of one step.
  struct Evidence {
    // nu^T S^-1 nu
    double squared_innovation = 0.0;
    double log_likelihood_ratio = 0.0;
  };

  // The filter of the query's path. `inflation` multiplies the standard
  // deviations of the nodes' motion under this correlation model. Statistics
  // that the indexes of graphs do not have are measured.
  ShapeFilter(const Query& query, const Correlation& correlation,
              const ShapeModel& model, const PlaceTolerance& place_tolerance,
              double spacing_meters, double inflation);

  // Nodes of the path.
  std::int64_t size() const { return static_cast<std::int64_t>(steps_.size()); }

  // The cost that every path is charged with, nats. A path that covers all
  // steps has it back with the last; where the recent path is a single node,
  // there is none, since that node is all there is to cover.
  double join_cost() const { return steps_.size() > 1 ? kJoinCost : 0.0; }

  // Carries the drift from step t - 1 to step t, at which the other path is at
  // `other`, seen from its own end. REQUIRES: t in [1, size()).
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

  // The step in the form that the kernel takes. The caller sets `to_come` and
  // `settled`.
  WalkStep Kernel(std::int64_t t) const;

  // E such that a path whose drift_0 is estimated as s has squared innovations
  // of at least s^T E^-1 s in sum.
  const StateMatrix<D>& EndShift() const { return end_shift_; }
  // The same for what is added to that estimate after step t: E such that an
  // addition of s takes squared innovations of at least s^T E^-1 s after it.
  StateMatrix<D> EndShiftAfter(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)].end - steps_.back().end;
  }

  // The variances of headings by themselves: of drift_0, of the noise that the
  // drift gathers with each step, and of what each node strays.
  struct HeadingVariances {
    double end = 0.0;
    double noise = 0.0;
    double straying = 0.0;
  };
  const HeadingVariances& headings() const { return headings_; }

  // By how much the covariance of drift_0 has shrunk after step t, in the axes
  // of the vehicle at the end.
  const StateMatrix<D>& EndCertainty(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)].end_certainty;
  }

 private:
  struct Step {
    // The node of the path, seen from the end.
    StateVector<D> path;
    // The way from the node after it.
    double step_x = 0.0;
    double step_y = 0.0;
    StateMatrix<D> gain;
    StateMatrix<D> end_gain;
    // S^-1
    StateMatrix<D> information;
    double surprise = 0.0;
    StateMatrix<D> end_certainty;
    // Covariance of drift_0.
    StateMatrix<D> end;
  };

  // Covariances of the filter's errors.
  struct Errors {
    // Carries the covariances over a step, and sets its gains and information.
    // `noise` is that of both passes, `jitter` that of both nodes; the path and
    // the way to it are set already.
    void Advance(const StateMatrix<D>& noise, const StateMatrix<D>& tolerance,
                 const StateMatrix<D>& jitter, Step* step);

    // Covariance of the drift now.
    StateMatrix<D> now;
    // Covariance between drift_0 and the drift now.
    StateMatrix<D> cross;
    // Covariance of drift_0.
    StateMatrix<D> end;
  };

  std::vector<Step> steps_;
  StateMatrix<D> end_shift_ = StateMatrix<D>::Zero();
  HeadingVariances headings_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SHAPE_FILTER_H_
