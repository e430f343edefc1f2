// The chi-square gate: whether two pose estimates can be at one place. Which
// candidates are accepted, by this and by all else, is decided in verdict.cc.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_

#include <cstddef>
#include <optional>

#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/candidates/gate_result.h"

namespace revisit::core {

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

// The difference in the axes of the asking drive, and its gate. `matched` is a
// node of the history's graph. In another recording, its frame lies in this way
// (ShapeMatch::way); nothing where that is the unknown one.
std::optional<GatedDifference> DecideAt(const Query& query,
                                        const History& history,
                                        const SimilarityModel& model,
                                        const Gate& gate, NodeIndex matched,
                                        std::size_t way);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_GATE_H_
