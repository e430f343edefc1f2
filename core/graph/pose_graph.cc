#include "core/graph/pose_graph.h"

#include <algorithm>
#include <cassert>
#include <iterator>

namespace revisit::core {

ErrorTransition PoseGraph::transition(NodeIndex i) const {
  return transitions_.empty() ? ErrorTransition{} : transitions_[Position(i)];
}

NodeIndex PoseGraph::SegmentStart(NodeIndex i) const {
  return *std::prev(
      std::upper_bound(segment_starts_.begin(), segment_starts_.end(), i));
}

NodeIndex PoseGraph::SegmentEnd(NodeIndex i) const {
  const auto next =
      std::upper_bound(segment_starts_.begin(), segment_starts_.end(), i);
  return next == segment_starts_.end() ? size() : *next;
}

std::optional<NodeIndex> PoseGraph::NodeAtOrBefore(
    std::uint64_t sequence) const {
  // A node with this sequence and a fraction lies after the pose.
  NodeIndex low = 0;
  NodeIndex high = size();
  while (low < high) {
    const NodeIndex middle = low + (high - low) / 2;
    const Node candidate = node(middle);
    if (candidate.sequence < sequence ||
        (candidate.sequence == sequence && candidate.fraction == 0.0)) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  if (low == 0) return std::nullopt;
  return low - 1;
}

const std::vector<NodeIndex>& PoseGraph::LoopNeighbours(NodeIndex i) const {
  static const std::vector<NodeIndex> kNone;
  const auto found = loop_neighbours_.find(i);
  return found == loop_neighbours_.end() ? kNone : found->second;
}

std::vector<std::pair<NodeIndex, NodeIndex>> PoseGraph::LoopEdges() const {
  std::vector<std::pair<NodeIndex, NodeIndex>> edges;
  for (const auto& [from, neighbours] : loop_neighbours_) {
    for (NodeIndex to : neighbours) {
      if (from < to) edges.emplace_back(from, to);
    }
  }
  std::sort(edges.begin(), edges.end());
  return edges;
}

void PoseGraph::AddNode(const Node& node, bool starts_segment,
                        const std::optional<ErrorTransition>& transition) {
  assert(size_ == 0 || transition.has_value() == !transitions_.empty());
  if (starts_segment) segment_starts_.push_back(size());
  const std::size_t at = Position(size_) % NodeBlock::kSize;
  if (at == 0) blocks_.emplace_back();
  NodeBlock& block = blocks_.back();
  block.sequence[at] = node.sequence;
  block.fraction[at] = node.fraction;
  block.stamp_ns[at] = node.stamp_ns;
  block.travelled_meters[at] = node.travelled_meters;
  block.x[at] = node.pose.x;
  block.y[at] = node.pose.y;
  block.z[at] = node.pose.z;
  block.heading[at] = node.pose.heading;
  for (std::size_t k = 0; k < 10; ++k) {
    block.covariance[k][at] = node.covariance.upper[k];
  }
  ++size_;
  if (transition) transitions_.push_back(*transition);
}

void PoseGraph::AddLoopEdge(NodeIndex a, NodeIndex b) {
  assert(a != b);
  loop_neighbours_[a].push_back(b);
  loop_neighbours_[b].push_back(a);
}

bool PoseGraph::RemoveLoopEdge(NodeIndex a, NodeIndex b) {
  const auto remove = [this](NodeIndex from, NodeIndex to) {
    const auto found = loop_neighbours_.find(from);
    if (found == loop_neighbours_.end()) return false;
    auto& neighbours = found->second;
    const auto edge = std::find(neighbours.begin(), neighbours.end(), to);
    if (edge == neighbours.end()) return false;
    neighbours.erase(edge);
    if (neighbours.empty()) loop_neighbours_.erase(found);
    return true;
  };
  return remove(a, b) && remove(b, a);
}

}  // namespace revisit::core
