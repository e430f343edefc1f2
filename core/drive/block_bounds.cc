#include "core/drive/block_bounds.h"

#include <algorithm>

#include "core/drive/block_growth.h"

namespace revisit::core {
namespace {

constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);

NodeIndex FirstNode(std::size_t block) {
  return static_cast<NodeIndex>(block) * kBlock;
}

}  // namespace

void BlockBounds::Extend(const PoseGraph& graph) {
  while (FirstNode(blocks_.size() + 2) < graph.size()) {
    const std::size_t k = blocks_.size();
    Add(BoundsOf(graph.block(k), 0, NodeBlock::kSize));
    const std::uint32_t since = k == 0 ? 0 : growing_since_.back();
    growing_since_.push_back(
        Grows(graph, k) ? since : static_cast<std::uint32_t>(k + 1));
  }
}

void BlockBounds::Add(const NodeBounds& bounds) {
  if (blocks_.size() % kGroup == 0) {
    groups_.push_back(bounds);
  } else {
    Join(bounds, &groups_.back());
  }
  blocks_.push_back(bounds);
}

void BlockBounds::SaveBlocks(std::size_t first, std::size_t end,
                             ByteWriter* writer) const {
  writer->PutArray(blocks_.data() + first, end - first);
  writer->PutArray(growing_since_.data() + first, end - first);
}

bool BlockBounds::LoadBlocks(std::size_t count, ByteReader* reader) {
  for (std::size_t i = 0; i < count; ++i) {
    NodeBounds bounds;
    if (!reader->Get(&bounds) ||
        !AreFinite(&bounds.least_x, sizeof(bounds) / sizeof(double))) {
      return false;
    }
    Add(bounds);
  }
  for (std::size_t k = blocks_.size() - count; k < blocks_.size(); ++k) {
    std::uint32_t since = 0;
    if (!reader->Get(&since) || since > k + 1) return false;
    growing_since_.push_back(since);
  }
  return true;
}

// Errors grow in a block if they grow from each of its nodes to the first node
// two blocks on: over such a distance, the error of interpolated covariances
// does not matter.
bool BlockBounds::Grows(const PoseGraph& graph, std::size_t k) const {
  for (NodeIndex j = FirstNode(k); j < FirstNode(k + 1); ++j) {
    if (!NoiseIsAdded(state_space_, graph, j, FirstNode(k + 2))) return false;
  }
  return true;
}

std::size_t BlockBounds::FirstGrowing(const PoseGraph& graph, NodeIndex query,
                                      std::size_t blocks) const {
  // growing_since_ leads from even blocks to even and from odd to odd ones;
  // from the last of either, the query is yet to be reached.
  if (blocks == 0 || FirstNode(blocks + 1) > query ||
      !NoiseIsAdded(state_space_, graph, FirstNode(blocks), query) ||
      !NoiseIsAdded(state_space_, graph, FirstNode(blocks + 1), query)) {
    return blocks;
  }
  return std::min<std::size_t>(growing_since_[blocks - 1], blocks);
}

NodeBounds BoundsOf(const NodeBlock& block, std::size_t first,
                    std::size_t last) {
  NodeBounds bounds = {};
  for (std::size_t i = first; i < last; ++i) {
    const Pose pose = block.pose(i);
    const Covariance covariance = block.covariance(i);
    const VarianceRange variances = VariancesInAnyDirection(
        covariance(0, 0), covariance(0, 1), covariance(1, 1));
    const NodeBounds of_node = {pose.x, pose.x,          pose.y,
                                pose.y, variances.least, variances.most};
    if (i == first) {
      bounds = of_node;
    } else {
      Join(of_node, &bounds);
    }
  }
  return bounds;
}

void Join(const NodeBounds& more, NodeBounds* bounds) {
  bounds->least_x = std::min(bounds->least_x, more.least_x);
  bounds->most_x = std::max(bounds->most_x, more.most_x);
  bounds->least_y = std::min(bounds->least_y, more.least_y);
  bounds->most_y = std::max(bounds->most_y, more.most_y);
  bounds->least_variance =
      std::min(bounds->least_variance, more.least_variance);
  bounds->most_variance = std::max(bounds->most_variance, more.most_variance);
}

bool BlockBounds::Near(const Region& region, const NodeBounds& bounds) {
  const double x =
      std::max({bounds.least_x - region.x, region.x - bounds.most_x, 0.0});
  const double y =
      std::max({bounds.least_y - region.y, region.y - bounds.most_y, 0.0});
  const double variance = region.variance +
                          region.most_added * bounds.most_variance -
                          region.least_taken * bounds.least_variance;
  // Written so that NaN is near.
  return !(x * x + y * y > region.squared_per_variance * variance);
}

}  // namespace revisit::core
