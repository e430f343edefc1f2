// How probable each place of the history is, against the other places and
// against a place not seen before.
#ifndef REVISIT_CORE_CANDIDATES_POSTERIOR_H_
#define REVISIT_CORE_CANDIDATES_POSTERIOR_H_

#include <array>

#include "core/alignment/log_similarity.h"
#include "core/alignment/scored_ends.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Nodes this close to each other along the path are one place: a verifier that
// is shown one finds the other.
inline constexpr double kPlaceRadiusMeters = 10.0;

class Posterior {
 public:
  // Log-odds of the history nodes against a new place, for each direction;
  // empty for a direction that was not sought. The graph must outlive this.
  Posterior(const PoseGraph& graph, std::array<ScoredEnds, 2> log_odds);

  // Probability that the vehicle is at no place of the history.
  double new_place() const { return Probability(0.0); }

  // Claims for the place of j all nodes within kPlaceRadiusMeters of it that no
  // other place has claimed before, and returns how probable they are together.
  // So nodes that two neighbouring places share count for the first to claim.
  // O(log n + nodes claimed).
  double Claim(Direction direction, NodeIndex j);

 private:
  double Probability(double log_odds) const;

  const PoseGraph& graph_;
  // kImpossible for nodes that are claimed.
  std::array<ScoredEnds, 2> log_odds_;
  // Logarithm of the sum of all odds, the new place's 1 among them.
  double log_total_ = 0.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_POSTERIOR_H_
