// Picks the best end nodes of an alignment, one for each stretch of road.
#ifndef REVISIT_CORE_CANDIDATES_RANKING_H_
#define REVISIT_CORE_CANDIDATES_RANKING_H_

#include <vector>

#include "core/alignment/scored_ends.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

struct RankedEnd {
  NodeIndex matched = 0;
  double score = 0.0;
};

// The nodes nearer than `separation_meters` to the centre, along the path
// (travelled distance); the centre always. O(log n).
NodeRange NodesNearer(const PoseGraph& graph, NodeIndex centre,
                      double separation_meters);

// Takes the best end, leaves out what is near it, and so on, until
// `max_candidates` are found or none is left. Best first; of equal scores, the
// lower index; kImpossible ends are never taken. O(n) once, and for every
// candidate a hundredth of that and what is near it.
std::vector<RankedEnd> RankEnds(const PoseGraph& graph, const ScoredEnds& ends,
                                double separation_meters, int max_candidates);

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_RANKING_H_
