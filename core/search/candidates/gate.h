// The chi-square gate: whether two pose estimates can be at one place.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_

#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"

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

class Gate {
 public:
  // REQUIRES: probability in (0, 1).
  Gate(StateSpace space, double probability);

  // Accepts if squared_mahalanobis <= threshold().
  GateResult Decide(double squared_mahalanobis) const;
  GateResult IllConditioned() const;
  // Decides on a whole aligned stretch, at the same probability. Its squared
  // distance is that of the difference at its end plus the innovations of its
  // shape, discounted for what neighbouring steps share.
  // REQUIRES: positive degrees of freedom.
  GateResult DecidePath(double squared_mahalanobis,
                        double degrees_of_freedom) const;

  double threshold() const { return threshold_; }

 private:
  int degrees_of_freedom_;
  double probability_;
  double threshold_;
};

// Query minus matched, the covariance of that difference (Gamma, inflated,
// without the tolerance), and the gate's decision, with the tolerance.
struct GatedDifference {
  Pose difference;
  Covariance covariance;
  GateResult gate;
};

// `matched` is a node of the history's graph.
GatedDifference DecideAt(const Query& query, const History& history,
                         const SimilarityModel& model, const Gate& gate,
                         NodeIndex matched);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_
