// How good the nodes of history are as the end of an alignment, without those
// that cannot be one.
#ifndef REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_
#define REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_

#include <algorithm>
#include <cstddef>
#include <vector>

#include "core/graph/pose_graph.h"

namespace revisit::core {

struct ScoredEnd {
  NodeIndex node = 0;
  double score = 0.0;
};

// Sorted by node, each node once. Nodes that are absent are impossible, as are
// those of score kImpossible.
using ScoredEnds = std::vector<ScoredEnd>;

// Of nodes 0, 1, ..., all that are not impossible.
ScoredEnds PossibleEnds(const std::vector<double>& scores);

// Nodes [first, last).
struct NodeRange {
  NodeIndex first = 0;
  NodeIndex last = 0;
};

// Makes those ends impossible that are of these nodes. O(log n), and as much
// for every end struck out.
void StrikeOut(const NodeRange& nodes, ScoredEnds* ends);

// Entries [first, last) of ScoredEnds; those from `later` on are of nodes after
// the centre.
struct EndsAround {
  std::size_t first = 0;
  std::size_t later = 0;
  std::size_t last = 0;
};

// The ends near a node, which need not be among them. `near` says of a node
// whether it is, and is true of all nodes between the centre and one it is true
// of. O(log n).
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

#endif  // REVISIT_CORE_ALIGNMENT_SCORED_ENDS_H_
