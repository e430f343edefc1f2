// Scores of history nodes as the end of an alignment, for those nodes that can
// be one.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SCORED_ENDS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SCORED_ENDS_H_

#include <algorithm>
#include <cstddef>
#include <vector>

#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"

namespace revisit::core {

struct ScoredEnd {
  NodeIndex node = 0;
  double score = 0.0;
  // Nodes around this one that have about the same score and are no ends
  // themselves, this one among them.
  double nodes = 1.0;
};

// Sorted by node, each node at most once. Absent nodes are impossible, as are
// those with the score kImpossible.
using ScoredEnds = std::vector<ScoredEnd>;

// An end for each i with scores[i] != kImpossible.
ScoredEnds PossibleEnds(const std::vector<double>& scores);

// Makes the ends at these nodes impossible. O(log n + ends struck out).
void StrikeOut(const NodeRange& nodes, ScoredEnds* ends);

// Entries [first, last) of ScoredEnds; the nodes of entries from `later` on lie
// after the centre.
struct EndsAround {
  std::size_t first = 0;
  std::size_t later = 0;
  std::size_t last = 0;
};

// The ends near the centre, a node which need not be among them. near(node)
// says whether a node is near. REQUIRES: it is true for all nodes between the
// centre and a node for which it is true. O(log n).
template <typename Near>
EndsAround FindEndsAround(const ScoredEnds& ends, NodeIndex centre,
                          const Near& near) {
  const auto later = std::partition_point(
      ends.begin(), ends.end(),
      [&](const ScoredEnd& end) { return end.node <= centre; });
  const auto first = std::partition_point(
      ends.begin(), later,
      [&](const ScoredEnd& end) { return !near(end.node); });
  const auto last = std::partition_point(
      later, ends.end(), [&](const ScoredEnd& end) { return near(end.node); });
  const auto position = [&ends](ScoredEnds::const_iterator at) {
    return static_cast<std::size_t>(at - ends.begin());
  };
  return {position(first), position(later), position(last)};
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SCORED_ENDS_H_
