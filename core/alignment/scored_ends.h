// Nodes of history with what they scored as ends.
#ifndef REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_
#define REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_

#include <vector>

#include "core/graph/pose_graph.h"

namespace revisit::core {

struct ScoredEnd {
  NodeIndex node = 0;
  double score = 0.0;
};

// Sorted by node; those that are absent are impossible.
using ScoredEnds = std::vector<ScoredEnd>;

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_
