// Independent fixes: no error tells anything of another, Psi = 0. Epochs of
// satellite navigation, or poses found in a map one by one.
#ifndef REVISIT_CORE_NOISE_INDEPENDENT_FIXES_H_
#define REVISIT_CORE_NOISE_INDEPENDENT_FIXES_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

struct IndependentFixes {
  static constexpr NoiseModel Row() {
    NoiseModel row;
    row.form = DifferenceForm::kSummed;
    row.claimed_growth = ClaimedGrowth::kDoesNotGrow;
    row.is_white = true;
    row.exceeds_either = true;
    row.fixes_place = true;
    // The end's own fix tells the place, and what lies far back only adds its
    // noise.
    row.long_overlaps_tell = false;
    return row;
  }

  template <int D>
  static StateMatrix<D> Difference(const PathPair<D>& pair, double /*meters*/) {
    return pair.earlier + pair.later;
  }

  template <int D>
  static StateMatrix<D> Cross(const PathPair<D>& /*pair*/, double /*meters*/) {
    return StateMatrix<D>::Zero();
  }

  // Errors do not accumulate: all of a node's error is its own.
  template <int D>
  static StateMatrix<D> OfStep(const PathPair<D>& step, double /*meters*/) {
    return step.later;
  }

  template <int D>
  static StepNoise<D> Split(const StateMatrix<D>& mean) {
    StepNoise<D> noise;
    noise.jitter = mean;
    return noise;
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_INDEPENDENT_FIXES_H_
