// Dead reckoning: each error is that of the pose before, carried on, plus what
// the step adds. Wheel or visual odometry, inertial navigation without fixes.
//
// The heading error swings all that follows about the pose at which it is, so
// Psi is the identity except for the column of heading, which is the lever arm
// J (p_j - p_i) in x and y, with J the turn by a right angle. It depends on the
// two poses alone: nothing has to be stored, and Gamma takes O(1).
#ifndef REVISIT_CORE_NOISE_DEAD_RECKONING_H_
#define REVISIT_CORE_NOISE_DEAD_RECKONING_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// Psi.
template <int D>
StateMatrix<D> DeadReckoningTransition(const Pose& earlier, const Pose& later) {
  StateMatrix<D> psi = StateMatrix<D>::Identity();
  psi(0, D - 1) = -(later.y - earlier.y);
  psi(1, D - 1) = later.x - earlier.x;
  return psi;
}

// A covariance that swings with its heading from the earlier pose to the later
// one: Psi S Psi^T.
template <int D>
StateMatrix<D> Swung(const StateMatrix<D>& covariance, const Pose& earlier,
                     const Pose& later) {
  return Swung<D>(covariance, -(later.y - earlier.y), later.x - earlier.x);
}

// Gamma in closed form. With h the index of heading and l the lever arm
// J (p_later - p_earlier), which is 0 except in x and y, Psi is I + l e_h^T and
//
//   Gamma(r,c) = later(r,c) - earlier(r,c)
//                - (l_r earlier(h,c) + l_c earlier(h,r)).
template <int D>
StateMatrix<D> DeadReckoningDifferenceCovariance(
    const Pose& earlier, const Pose& later,
    const StateMatrix<D>& earlier_covariance,
    const StateMatrix<D>& later_covariance) {
  const double lever[2] = {-(later.y - earlier.y), later.x - earlier.x};
  constexpr int h = D - 1;
  StateMatrix<D> gamma;
  for (int c = 0; c < D; ++c) {
    for (int r = c; r < D; ++r) {
      double entry = later_covariance(r, c) - earlier_covariance(r, c);
      if (r < 2) {
        entry -= lever[r] * earlier_covariance(h, c) +
                 lever[c] * earlier_covariance(h, r);
      } else if (c < 2) {
        entry -= lever[c] * earlier_covariance(h, r);
      }
      gamma(r, c) = gamma(c, r) = entry;
    }
  }
  return gamma;
}

struct DeadReckoning {
  static constexpr NoiseModel Row() {
    NoiseModel row;
    row.form = DifferenceForm::kGrown;
    row.claimed_growth = ClaimedGrowth::kGrows;
    // One error is carried on for as long as the drive goes: a closure, or a
    // mark that found its place, shows it to all that follows.
    row.closures_show_drift = true;
    row.lets_belief_begin = true;
    row.neighbours_err_alike = true;
    row.has_margin_per_step = true;
    return row;
  }

  template <int D>
  static StateMatrix<D> Difference(const PathPair<D>& pair, double /*meters*/) {
    return DeadReckoningDifferenceCovariance<D>(
        pair.earlier_pose, pair.later_pose, pair.earlier, pair.later);
  }

  template <int D>
  static StateMatrix<D> Cross(const PathPair<D>& pair, double /*meters*/) {
    return DeadReckoningTransition<D>(pair.earlier_pose, pair.later_pose) *
           pair.earlier;
  }

  // Cov(e_j - Psi e_i).
  template <int D>
  static StateMatrix<D> OfStep(const PathPair<D>& step, double /*meters*/) {
    const StateMatrix<D> psi =
        DeadReckoningTransition<D>(step.earlier_pose, step.later_pose);
    const StateMatrix<D> carried = psi * step.earlier;
    StateMatrix<D> added = step.later;
    added -= carried * psi.transpose();
    return added;
  }

  template <int D>
  static StepNoise<D> Split(const StateMatrix<D>& mean) {
    StepNoise<D> noise;
    noise.drift = mean;
    return noise;
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_DEAD_RECKONING_H_
