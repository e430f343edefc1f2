// Where a search looks: the nodes of a drive that the recent path is compared
// with.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_

#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/heading_bins.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/relation.h"

namespace revisit::core {

struct History {
  // A drive, or a copy of it as it was. Outlives the history.
  const PoseGraph& graph;
  // Nodes [0, size) may be compared, in a frame of their own.
  NodeIndex size = 0;
  // Ranges whose nodes may not be ends. May overlap.
  std::vector<NodeRange> not_sought = {};
  // Indexes of the graph, or null. No ends are sampled without the headings of
  // all `size` nodes, and every node is looked at in blocks without bounds.
  const HeadingBins* heading_bins = nullptr;
  const BlockBounds* block_bounds = nullptr;
  // How the history lies to the drive that asks.
  Relation relation = {};
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_
