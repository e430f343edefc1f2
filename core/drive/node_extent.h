// Where stretches of nodes lie and how much they err: what shows a search at
// one look that a whole history is far away.
#ifndef REVISIT_CORE_DRIVE_NODE_EXTENT_H_
#define REVISIT_CORE_DRIVE_NODE_EXTENT_H_

#include <cstddef>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"

namespace revisit::core {

// Blocks of one extent, 16 km of nodes that are 2 m apart.
inline constexpr std::size_t kBlocksOfExtent = 64;

struct NodeExtent {
  NodeBounds bounds;
  double most_z_variance = 0.0;
  double most_heading_variance = 0.0;
};

// The extents of the nodes of a range, which may be empty, stretch by stretch.
// `bounds` are those of the graph, as far as they are known; nodes of other
// blocks are measured. O(nodes).
std::vector<NodeExtent> ExtentsOf(const PoseGraph& graph,
                                  const BlockBounds& bounds,
                                  const NodeRange& nodes);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_NODE_EXTENT_H_
