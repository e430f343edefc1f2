// Picks the best end nodes of an alignment, one for each stretch of road.
#ifndef REVISIT_CORE_CANDIDATES_RANKING_H_
#define REVISIT_CORE_CANDIDATES_RANKING_H_

#include <vector>

#include "core/alignment/viterbi.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

struct RankedEnd {
  NodeIndex matched = 0;
  double score = 0.0;
};

// Takes the best node, strikes out all nodes nearer than `separation_meters` to
// it along the path (travelled distance), and so on, until `max_candidates` are
// found or none is left. Nodes that near the query are struck out first. Best
// first; of equal scores, the lower index; nodes where no path ends are never
// taken.
std::vector<RankedEnd> RankEnds(const PoseGraph& graph,
                                const Alignment& alignment, NodeIndex query,
                                double separation_meters, int max_candidates);

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_RANKING_H_
