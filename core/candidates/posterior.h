// How probable each place of the history is, against the others and against a
// place not seen before.
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
  // Log-odds of the history nodes against a new place, by direction; empty for
  // one that was not sought. The graph must outlive this.
  Posterior(const PoseGraph& graph, std::array<ScoredEnds, 2> log_odds);

  double new_place() const { return Probability(0.0); }

  // Takes for the place of j all nodes within kPlaceRadiusMeters of it that no
  // place has taken before, and answers how probable they are together. So what
  // two neighbouring places share counts for the one that is asked for first.
  // O(log n), and as much for every node taken.
  double Claim(Direction direction, NodeIndex j);

 private:
  double Probability(double log_odds) const;

  const PoseGraph& graph_;
  // kImpossible for what is claimed.
  std::array<ScoredEnds, 2> log_odds_;
  // ln of the sum of all odds, the new place's 1 among them.
  double log_total_ = 0.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_POSTERIOR_H_
