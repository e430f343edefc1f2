// How far an alignment has come, in both directions together.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_PROGRESS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_PROGRESS_H_

#include <bitset>
#include <cstddef>
#include <vector>

#include "core/drive/pose_graph.h"

namespace revisit::core {

// A bit for each node of a block.
using BlockNodes = std::bitset<NodeBlock::kSize>;

// The block that holds a node, and where the node stands in it.
inline std::size_t BlockOf(NodeIndex i) {
  return static_cast<std::size_t>(i) / NodeBlock::kSize;
}
inline std::size_t PlaceInBlock(NodeIndex i) {
  return static_cast<std::size_t>(i) % NodeBlock::kSize;
}

class SearchProgress {
 public:
  // The history has the nodes [first, end).
  SearchProgress(NodeIndex first, NodeIndex end)
      : first_(first), considered_(BlocksOf(end)) {}

  // The greatest log-odds that were found, or those of a new place.
  double greatest() const { return greatest_; }
  void Found(double log_odds) {
    if (log_odds > greatest_) greatest_ = log_odds;
  }

  // Counts a node as considered: walked from, counted by another that stands
  // for it, not sought, or ill-conditioned.
  // Nodes before the history do not count.
  void Consider(NodeIndex i) {
    if (i >= first_) considered_[BlockOf(i)].set(PlaceInBlock(i));
  }
  NodeIndex considered() const {
    NodeIndex count = 0;
    for (const BlockNodes& block : considered_) {
      count += static_cast<NodeIndex>(block.count());
    }
    return count;
  }

 private:
  NodeIndex first_;
  double greatest_ = 0.0;
  std::vector<BlockNodes> considered_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_PROGRESS_H_
