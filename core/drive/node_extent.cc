#include "core/drive/node_extent.h"

#include <algorithm>

#include "core/geometry/pose.h"

namespace revisit::core {
namespace {

constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);

// The extent of nodes [first, last), which are some of block k.
NodeExtent ExtentIn(const PoseGraph& graph, const BlockBounds& bounds,
                    std::size_t k, NodeIndex first, NodeIndex last) {
  const NodeBlock& block = graph.block(k);
  const auto place = [k](NodeIndex i) {
    return static_cast<std::size_t>(i) - k * NodeBlock::kSize;
  };
  const bool is_known = last - first == kBlock && k < bounds.size();
  NodeExtent extent;
  extent.bounds = is_known ? bounds.of_block(k)
                           : BoundsOf(block, place(first), place(last));
  for (std::size_t i = place(first); i < place(last); ++i) {
    const Covariance covariance = block.covariance(i);
    extent.most_z_variance = std::max(extent.most_z_variance, covariance(2, 2));
    extent.most_heading_variance =
        std::max(extent.most_heading_variance, covariance(3, 3));
  }
  return extent;
}

void Join(const NodeExtent& more, NodeExtent* extent) {
  Join(more.bounds, &extent->bounds);
  extent->most_z_variance =
      std::max(extent->most_z_variance, more.most_z_variance);
  extent->most_heading_variance =
      std::max(extent->most_heading_variance, more.most_heading_variance);
}

}  // namespace

std::vector<NodeExtent> ExtentsOf(const PoseGraph& graph,
                                  const BlockBounds& bounds,
                                  const NodeRange& nodes) {
  std::vector<NodeExtent> extents;
  std::size_t joined = kBlocksOfExtent;
  for (NodeIndex first = nodes.first; first < nodes.last;) {
    const NodeIndex last = std::min((first / kBlock + 1) * kBlock, nodes.last);
    const NodeExtent of_block = ExtentIn(
        graph, bounds, static_cast<std::size_t>(first / kBlock), first, last);
    if (joined == kBlocksOfExtent) {
      extents.push_back(of_block);
      joined = 0;
    } else {
      Join(of_block, &extents.back());
    }
    ++joined;
    first = last;
  }
  return extents;
}

}  // namespace revisit::core
