// Where a search looks: the nodes of a drive, the one that asks or another one,
// that the recent path is compared with.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_

#include <cstddef>
#include <optional>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/heading_bins.h"
#include "core/drive/node_extent.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/relation.h"

namespace revisit::core {

struct History {
  NodeIndex size() const { return end - first; }

  // A drive, or a copy of it as it was. Outlives the history.
  const PoseGraph& graph;
  // Nodes [first, end) may be compared, in a frame of their own.
  NodeIndex end = 0;
  // Ranges whose nodes may not be ends. May overlap.
  std::vector<NodeRange> not_sought = {};
  // Indexes of the graph, or null. No ends are sampled without the headings of
  // all nodes before the end, and every node is looked at in blocks without
  // bounds.
  const HeadingBins* heading_bins = nullptr;
  const BlockBounds* block_bounds = nullptr;
  // How the history lies to the drive that asks.
  Relation relation = {};
  // A recording begins there, so that no road leads farther back.
  NodeIndex first = 0;
  // Its frame, among those of all histories (FrameRelations).
  std::size_t frame = 0;
  // For another recording, in which errors count from a reference: whether they
  // grow from each node of a block to it, or from it to each node
  // (block_growth.h). By block of the graph; null where it is not known.
  const std::vector<char>* growing = nullptr;
  // Whether they do so for all nodes of the history but the reference.
  bool all_grow = false;
  // Where its nodes lie, or null: then no look is enough to rule out all.
  const std::vector<NodeExtent>* extents = nullptr;
  // For another drive than the one that asks: its index in the scope of the
  // search, and FrameNodes::known_scale.
  std::optional<std::size_t> drive = std::nullopt;
  std::optional<double> known_scale = std::nullopt;
};

// The drifts that are held possible there: the model's in the past of the
// query's own recording, and those that the relation knows in others.
inline const std::vector<WeighedDrift>& DriftsIn(
    const History& history, const std::vector<WeighedDrift>& own) {
  return history.relation.is_own() ? own : history.relation.drifts();
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_HISTORY_H_
