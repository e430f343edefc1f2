// Ranges of nodes, and those that lie near a node along the path.
#ifndef REVISIT_CORE_DRIVE_NODE_RANGE_H_
#define REVISIT_CORE_DRIVE_NODE_RANGE_H_

#include "core/drive/node_index.h"
#include "core/drive/pose_graph.h"

namespace revisit::core {

class PoseGraph;

// Nodes [first, last).
struct NodeRange {
  NodeIndex first = 0;
  NodeIndex last = 0;
};

// The nodes that are in both.
inline NodeRange Common(const NodeRange& a, const NodeRange& b) {
  const NodeIndex first = a.first > b.first ? a.first : b.first;
  const NodeIndex last = a.last < b.last ? a.last : b.last;
  return {first, last < first ? first : last};
}

// The first of [first, last) with a property that all after it have too; `last`
// if none has it. O(log n).
template <typename Property>
NodeIndex FirstWith(NodeIndex first, NodeIndex last, const Property& has) {
  while (first < last) {
    const NodeIndex middle = first + (last - first) / 2;
    if (has(middle)) {
      last = middle;
    } else {
      first = middle + 1;
    }
  }
  return first;
}

// Nodes this close to each other along the path are one place: a verifier that
// is shown one finds the other.
inline constexpr double kPlaceRadiusMeters = 10.0;

// Whether a node is nearer to the centre than that along the path (in travelled
// distance); the centre itself is.
bool IsNearer(const PoseGraph& graph, NodeIndex centre,
              double separation_meters, NodeIndex i);

// All nodes for which IsNearer(). O(log n).
NodeRange NodesNearer(const PoseGraph& graph, NodeIndex centre,
                      double separation_meters);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_NODE_RANGE_H_
