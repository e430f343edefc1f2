// Two poses of one path, as the noise models take them (models.h).
//
// e is the error of a pose, S its covariance. For any forward filter the error
// obeys e_j = Psi(j,i) e_i + (noise independent of e_i) for i before j, so the
// cross-covariance S_ij = S_ii Psi(j,i)^T follows from the covariance of the
// earlier pose alone, and the covariance of the difference is (paper, Eq. 3)
//
//   Gamma_ij = S_ii + S_jj - S_ii Psi(j,i)^T - Psi(j,i) S_ii.
#ifndef REVISIT_CORE_NOISE_PATH_PAIR_H_
#define REVISIT_CORE_NOISE_PATH_PAIR_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {

template <int D>
struct PathPair {
  Pose earlier_pose;
  Pose later_pose;
  // S of either.
  StateMatrix<D> earlier;
  StateMatrix<D> later;
  // Distance between the two along the path. Counts where
  // NoiseModel::decorrelates_over_way.
  double meters_apart = 0.0;
  // Psi(later, earlier) as the poses brought it. Counts where
  // NoiseModel::carries_transitions.
  StateMatrix<D> transition = StateMatrix<D>::Identity();
};

// The noise of one step from a pose to the next, in the axes of the vehicle at
// the later one: x forward, y left, z up. Both are covariances.
template <int D>
struct StepNoise {
  // The noise that the step adds to the error of all that follows.
  StateMatrix<D> drift = StateMatrix<D>::Zero();
  // The error of each pose that is independent of the others'.
  StateMatrix<D> jitter = StateMatrix<D>::Zero();
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_PATH_PAIR_H_
