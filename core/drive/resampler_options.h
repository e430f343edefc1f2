#ifndef REVISIT_CORE_DRIVE_RESAMPLER_OPTIONS_H_
#define REVISIT_CORE_DRIVE_RESAMPLER_OPTIONS_H_

#include "core/geometry/state_space.h"

namespace revisit::core {

// How poses become nodes (distance_resampler.h).
struct ResamplerOptions {
  StateSpace state_space = StateSpace::kPlanar;
  // Whether nodes get error transitions; all samples but the first must have
  // them.
  bool carry_transitions = false;
  // Whether errors are carried on by dead reckoning, so that claims of another
  // shape do not count as they are (carried_claim.h).
  bool carry_claims = false;
  double spacing_meters = 2.0;
  double max_step_meters = 100.0;
  double standstill_fraction = 0.05;

  // A step from the last counted pose adds distance unless it is one of these.
  bool IsStandstill(double step_meters) const {
    return step_meters < standstill_fraction * spacing_meters;
  }
  bool IsJump(double step_meters) const {
    return step_meters > max_step_meters;
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_RESAMPLER_OPTIONS_H_
