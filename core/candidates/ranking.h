// Picks the best end nodes of an alignment, one for each stretch of road.
#ifndef REVISIT_CORE_CANDIDATES_RANKING_H_
#define REVISIT_CORE_CANDIDATES_RANKING_H_

#include <vector>

#include "core/graph/pose_graph.h"

namespace revisit::core {

struct RankedEnd {
  NodeIndex matched = 0;
  double score = 0.0;
};

// Makes all nodes nearer than `separation_meters` to the centre, along the path
// (travelled distance), impossible; the centre always. The centre need not be
// among the nodes with scores, which are the graph's first.
void StrikeOut(const PoseGraph& graph, NodeIndex centre,
               double separation_meters, std::vector<double>* scores);

// Takes the best node, strikes out what is near it, and so on, until
// `max_candidates` are found or none is left. Best first; of equal scores, the
// lower index; kImpossible nodes are never taken.
std::vector<RankedEnd> RankEnds(const PoseGraph& graph,
                                std::vector<double> scores,
                                double separation_meters, int max_candidates);

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_RANKING_H_
