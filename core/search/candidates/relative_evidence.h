// The evidence for a candidate that only a relative alignment has.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_EVIDENCE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_EVIDENCE_H_

#include <optional>

#include "core/search/candidates/gate_result.h"

namespace revisit::core {

struct RelativeEvidence {
  // Posterior probability of this stretch of road (kStretchRadiusMeters), and
  // its ratio to that of the best other place, if there is one.
  double probability = 0.0;
  std::optional<double> odds_to_runner_up;
  // How far along the path, before and after the matched node, the place may
  // lie: with kIntervalShare of that probability it is between.
  double meters_before = 0.0;
  double meters_after = 0.0;
  GateResult path_gate;
  // ShapeMatch::squared_end_difference.
  double squared_end_difference = 0.0;
  // How far back the two paths run together, and the logarithm of how much
  // likelier their shapes are on the same road than on different ones.
  double overlap_meters = 0.0;
  double log_likelihood_ratio = 0.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_EVIDENCE_H_
