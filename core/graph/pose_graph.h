// The pose graph of one vehicle: nodes spaced evenly by travelled distance,
// edges between consecutive nodes and for confirmed loop closures.
//
// Indices are dense and grow with the travelled distance. Edges are undirected.
// Where the trajectory jumped, consecutive nodes have no edge; the nodes
// between two such places form a segment.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_GRAPH_POSE_GRAPH_H_
#define REVISIT_CORE_GRAPH_POSE_GRAPH_H_

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/geometry/pose.h"

namespace revisit::core {

using NodeIndex = std::int64_t;

struct Node {
  // The pose at or before the node, and how far on towards the next one it
  // lies, in [0, 1).
  std::uint64_t sequence = 0;
  double fraction = 0.0;
  std::optional<std::int64_t> stamp_ns;
  // Distance travelled to here, without jumps.
  double travelled_meters = 0.0;
  // Heading in (-pi, pi].
  Pose pose;
  Covariance covariance;
};

// Nodes side by side, one array a quantity: the similarity of a query with all
// of history reads them in order and many at once. Entries beyond the last node
// of a graph are 0.
struct NodeBlock {
  static constexpr std::size_t kSize = 128;
  template <typename T>
  using Column = std::array<T, kSize>;

  alignas(64) Column<double> x{};
  Column<double> y{};
  Column<double> z{};
  Column<double> heading{};
  // Entries as Covariance::upper has them.
  std::array<Column<double>, 10> covariance{};
  Column<double> travelled_meters{};
  Column<double> fraction{};
  Column<std::uint64_t> sequence{};
  Column<std::optional<std::int64_t>> stamp_ns{};
};

// Blocks that hold the first `count` nodes.
inline std::size_t BlocksOf(NodeIndex count) {
  return (static_cast<std::size_t>(count) + NodeBlock::kSize - 1) /
         NodeBlock::kSize;
}

class PoseGraph {
 public:
  NodeIndex size() const { return size_; }
  // Gathered from its block.
  Node node(NodeIndex i) const {
    const NodeBlock& block = blocks_[Position(i) / NodeBlock::kSize];
    const std::size_t at = Position(i) % NodeBlock::kSize;
    Node node;
    node.sequence = block.sequence[at];
    node.fraction = block.fraction[at];
    node.stamp_ns = block.stamp_ns[at];
    node.travelled_meters = block.travelled_meters[at];
    node.pose = {block.x[at], block.y[at], block.z[at], block.heading[at]};
    for (std::size_t k = 0; k < 10; ++k) {
      node.covariance.upper[k] = block.covariance[k][at];
    }
    return node;
  }
  // Between two nodes, along the path.
  double MetersApart(NodeIndex i, NodeIndex j) const {
    return std::abs(TravelledMeters(i) - TravelledMeters(j));
  }
  // Nodes from k * NodeBlock::kSize on.
  const NodeBlock& block(std::size_t k) const { return blocks_[k]; }

  // The error transition from node i-1 to node i; identity for node 0 and where
  // none was given.
  ErrorTransition transition(NodeIndex i) const;

  // First node of the segment that holds node i.
  NodeIndex SegmentStart(NodeIndex i) const;
  // First node after that segment; size() if it is the last.
  NodeIndex SegmentEnd(NodeIndex i) const;

  // Last node at or before the pose: nothing if there is none.
  std::optional<NodeIndex> NodeAtOrBefore(std::uint64_t sequence) const;

  bool has_loop_edges() const { return !loop_neighbours_.empty(); }

  // Other ends of the loop-closure edges at i, in the order they were added.
  const std::vector<NodeIndex>& LoopNeighbours(NodeIndex i) const;

  // Every loop-closure edge once, from < to, in the order of `from`.
  std::vector<std::pair<NodeIndex, NodeIndex>> LoopEdges() const;

  // `starts_segment`: no edge to the node before. `transition` only for
  // vehicles whose errors are carried by the caller's filter: give it for all
  // nodes or for none.
  void AddNode(const Node& node, bool starts_segment,
               const std::optional<ErrorTransition>& transition);

  // An edge between two nodes that differ. The same edge may be there more than
  // once (two loop closures between the same nodes); each counts for the
  // degree.
  void AddLoopEdge(NodeIndex a, NodeIndex b);
  // Removes one edge of the two. Returns whether there was one.
  bool RemoveLoopEdge(NodeIndex a, NodeIndex b);

 private:
  static std::size_t Position(NodeIndex i) {
    return static_cast<std::size_t>(i);
  }
  double TravelledMeters(NodeIndex i) const {
    return blocks_[Position(i) / NodeBlock::kSize]
        .travelled_meters[Position(i) % NodeBlock::kSize];
  }

  NodeIndex size_ = 0;
  // Never moved as the graph grows, and never much larger than the nodes need.
  std::deque<NodeBlock> blocks_;
  // As many as nodes, or none.
  std::vector<ErrorTransition> transitions_;
  std::vector<NodeIndex> segment_starts_;
  std::unordered_map<NodeIndex, std::vector<NodeIndex>> loop_neighbours_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_GRAPH_POSE_GRAPH_H_
