// The answer of the chi-square gate (gate.h).
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_GATE_RESULT_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_GATE_RESULT_H_

#include "core/geometry/pose.h"

namespace revisit::core {

enum class GateVerdict { kAccepted, kRejected, kIllConditioned };

struct GateResult {
  // d^T (Gamma + R)^-1 d; 0 if ill-conditioned.
  double squared_mahalanobis = 0.0;
  // The dimensions of the state; for a path more, and not a whole number.
  double degrees_of_freedom = 0.0;
  // Chi-square quantile of the degrees of freedom at the gate probability.
  double threshold = 0.0;
  // Probability that two estimates at one place have at least this squared
  // distance; 0 if ill-conditioned.
  double p_value = 0.0;
  GateVerdict verdict = GateVerdict::kIllConditioned;
};

// Query minus matched, the covariance of that difference (Gamma, inflated,
// without the tolerance), and the gate's decision, with the tolerance.
struct GatedDifference {
  Pose difference;
  Covariance covariance;
  GateResult gate;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_GATE_RESULT_H_
