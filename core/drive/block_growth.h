// Which blocks of a graph err as dead reckoning does: from node to node, errors
// are carried on and grow.
#ifndef REVISIT_CORE_DRIVE_BLOCK_GROWTH_H_
#define REVISIT_CORE_DRIVE_BLOCK_GROWTH_H_

#include <vector>

#include "core/drive/node_index.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/state_space.h"

namespace revisit::core {

// Whether the error at the later node can be the error at the earlier one,
// carried on by dead reckoning, plus new noise in every direction.
bool NoiseIsAdded(StateSpace space, const PoseGraph& graph, NodeIndex earlier,
                  NodeIndex later);

// For each block that ends at or before the range does, whether all of it is in
// the range, and errors grow from each of its nodes to the reference, or from
// that to each of them. O(nodes). REQUIRES: the reference is in the range.
std::vector<char> BlocksGrowing(StateSpace space, const PoseGraph& graph,
                                const NodeRange& nodes, NodeIndex reference);

// Whether errors grow so at all nodes of the range but the reference itself.
// `growing` are its blocks. O(nodes outside these).
bool AllGrow(StateSpace space, const PoseGraph& graph, const NodeRange& nodes,
             NodeIndex reference, const std::vector<char>& growing);

// Both of a range and a reference.
struct Growth {
  std::vector<char> blocks;
  bool all_grow = false;
};
Growth GrowthFrom(StateSpace space, const PoseGraph& graph,
                  const NodeRange& nodes, NodeIndex reference);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_BLOCK_GROWTH_H_
