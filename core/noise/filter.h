// Filter: the vehicle's own filter says how each error comes from that of the
// pose before. Each pose brings this error transition, (I - K H) F for a Kalman
// filter, and Psi is the product of those between two poses.
//
// Psi is run backward from the later pose, and never inverted: so the product
// can stop as soon as the errors have decorrelated.
#ifndef REVISIT_CORE_NOISE_FILTER_H_
#define REVISIT_CORE_NOISE_FILTER_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// A product of error transitions with no entry above this counts as zero: the
// errors have decorrelated. Entries of different units are compared as they are
// in metres and radians.
inline constexpr double kDecorrelatedNorm = 1e-9;

// Psi(later, i), as i goes back from the later pose.
template <int D>
class BackwardTransition {
 public:
  const StateMatrix<D>& psi() const { return psi_; }
  // Once true, psi() stays zero.
  bool decorrelated() const { return decorrelated_; }
  // Goes back over a step of this transition. REQUIRES: not decorrelated.
  void GoBack(const ErrorTransition& step) {
    psi_ *= ToMatrix<D>(step);
    if (psi_.template lpNorm<Eigen::Infinity>() < kDecorrelatedNorm) {
      psi_.setZero();
      decorrelated_ = true;
    }
  }

 private:
  StateMatrix<D> psi_ = StateMatrix<D>::Identity();
  bool decorrelated_ = false;
};

// Gamma from the two covariances and Psi.
template <int D>
StateMatrix<D> DifferenceCovariance(const StateMatrix<D>& earlier_covariance,
                                    const StateMatrix<D>& later_covariance,
                                    const StateMatrix<D>& psi) {
  const StateMatrix<D> carried = psi * earlier_covariance;
  return earlier_covariance + later_covariance - carried - carried.transpose();
}

struct Filter {
  // Its errors may be correlated in any way, so nothing can be relied on.
  static constexpr NoiseModel Row() {
    NoiseModel row;
    row.form = DifferenceForm::kOfPath;
    row.carries_transitions = true;
    return row;
  }

  template <int D>
  static StateMatrix<D> Difference(const PathPair<D>& pair, double /*meters*/) {
    return DifferenceCovariance<D>(pair.earlier, pair.later, pair.transition);
  }

  template <int D>
  static StateMatrix<D> Cross(const PathPair<D>& pair, double /*meters*/) {
    return pair.transition * pair.earlier;
  }

  // Cov(e_j - F e_i) with F the transition of dead reckoning, by which paths
  // are compared:
  //
  //   S_j + F S_i F^T - Psi S_i F^T - F S_i Psi^T.
  template <int D>
  static StateMatrix<D> OfStep(const PathPair<D>& step, double /*meters*/) {
    const StateMatrix<D> f =
        DeadReckoningTransition<D>(step.earlier_pose, step.later_pose);
    const StateMatrix<D> carried = f * step.earlier;
    const StateMatrix<D> mixed = carried * step.transition.transpose();
    StateMatrix<D> added = step.later;
    added += carried * f.transpose() - mixed - mixed.transpose();
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

#endif  // REVISIT_CORE_NOISE_FILTER_H_
