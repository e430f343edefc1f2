// Picks the best end nodes of an alignment, one per stretch of road.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_RANKING_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_RANKING_H_

#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/scored_ends.h"

namespace revisit::core {

struct RankedEnd {
  NodeIndex matched = 0;
  double score = 0.0;
};

// Takes the best end, leaves out the ends near it, and repeats until
// `max_candidates` are found or no end is left. Best first; of equal scores,
// the lower index; kImpossible ends are never taken. O(n), plus for each
// candidate n / 128 and the number of ends near it.
std::vector<RankedEnd> RankEnds(const PoseGraph& graph, const ScoredEnds& ends,
                                double separation_meters, int max_candidates);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_RANKING_H_
