#include "core/search/candidates/verdict.h"

#include <cmath>

namespace revisit::core {
namespace {

// A candidate that another is this many times as probable as is not "about as
// good".
constexpr double kAmbiguousOdds = 10.0;

}  // namespace

Verdict GateAlone(GateVerdict gate) {
  switch (gate) {
    case GateVerdict::kAccepted:
      return Verdict::kAccepted;
    case GateVerdict::kRejected:
      return Verdict::kRejectedByGate;
    case GateVerdict::kIllConditioned:
      break;
  }
  return Verdict::kIllConditioned;
}

Verdict Decide(const GateResult* gate, const RelativeEvidence& evidence,
               const Alternatives& alternatives,
               double acceptance_probability) {
  const bool outside = gate != nullptr &&
                       gate->verdict == GateVerdict::kRejected &&
                       evidence.squared_end_difference > gate->threshold;
  if (outside ||
      (gate != nullptr && gate->verdict == GateVerdict::kIllConditioned)) {
    return GateAlone(gate->verdict);
  }
  if (evidence.path_gate.verdict == GateVerdict::kRejected) {
    return Verdict::kRejectedByShape;
  }
  const double here = evidence.probability;
  if (here >= acceptance_probability) return Verdict::kAccepted;
  if (1.0 - alternatives.new_place >= acceptance_probability) {
    // The vehicle is somewhere in the history.
    return alternatives.runner_up < acceptance_probability &&
                   here * kAmbiguousOdds >= alternatives.runner_up
               ? Verdict::kAmbiguous
               : Verdict::kRejectedByShape;
  }
  // Had the two ends coincided, with the same shape.
  const double at_best = here * std::exp(0.5 * evidence.squared_end_difference);
  const double total = 1.0 - here + at_best;
  if (at_best < acceptance_probability * total) {
    return Verdict::kUninformative;
  }
  return Verdict::kRejectedByShape;
}

}  // namespace revisit::core
