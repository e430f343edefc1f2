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
#include <bitset>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/geometry/pose.h"
#include "core/graph/packed_columns.h"

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

// What the similarity of a query with all of history reads, many nodes at once:
// groups of nodes one after the other, in each group one row a quantity, of
// eight nodes side by side. What else there is to a node is kept elsewhere.
class NodeBlock {
 public:
  static constexpr std::size_t kSize = 128;
  static constexpr std::size_t kGroupSize = 8;

  // Rows of a group. Those from kZ on are there only if spatial().
  enum Row : std::size_t {
    kX,
    kY,
    kHeading,
    kXX,
    kXY,
    kXH,
    kYY,
    kYH,
    kHH,
    kZ,
    kXZ,
    kYZ,
    kZZ,
    kZH,
  };
  static constexpr std::size_t kPlanarRows = kZ;
  static constexpr std::size_t kSpatialRows = kZH + 1;

  // Row of the covariance's entry r, c over (x, y, z, heading).
  static constexpr Row CovarianceRow(int r, int c) {
    constexpr Row kRows[] = {kXX, kXY, kXZ, kXH, kYY, kYZ, kYH, kZZ, kZH, kHH};
    return kRows[Covariance::Index(r, c)];
  }

  // Whether a node has anything but 0 in z or its covariances.
  bool spatial() const { return spatial_; }
  std::size_t rows() const { return spatial_ ? kSpatialRows : kPlanarRows; }
  // Entries of groups beyond the last node are 0.
  std::size_t groups() const { return lines_.size() / rows(); }
  // The rows of a group, one after the other, in whole lines of the cache.
  const double* group(std::size_t g) const {
    return lines_[g * rows()].entries.data();
  }
  const double* group(std::size_t g, Row row) const {
    return group(g) + row * kGroupSize;
  }

  // REQUIRES: at < kSize, below the number of nodes.
  Pose pose(std::size_t at) const {
    const double* const entry = group(at / kGroupSize) + at % kGroupSize;
    Pose pose;
    pose.x = entry[kX * kGroupSize];
    pose.y = entry[kY * kGroupSize];
    pose.heading = entry[kHeading * kGroupSize];
    if (spatial_) pose.z = entry[kZ * kGroupSize];
    return pose;
  }
  Covariance covariance(std::size_t at) const {
    const double* const entry = group(at / kGroupSize) + at % kGroupSize;
    Covariance covariance;
    for (int r = 0; r < 4; ++r) {
      for (int c = r; c < 4; ++c) {
        const Row row = CovarianceRow(r, c);
        if (row < kPlanarRows || spatial_) {
          covariance(r, c) = entry[row * kGroupSize];
        }
      }
    }
    return covariance;
  }

  // REQUIRES: `at` nodes so far, fewer than kSize. Memory is taken for so many
  // groups at a time.
  void Add(std::size_t at, const Pose& pose, const Covariance& covariance,
           std::size_t groups_at_a_time);

  std::size_t bytes() const { return lines_.capacity() * sizeof(Line); }

 private:
  struct alignas(64) Line {
    std::array<double, kGroupSize> entries{};
  };

  void BecomeSpatial();

  std::vector<Line> lines_;
  bool spatial_ = false;
};

// Blocks that hold the first `count` nodes.
inline std::size_t BlocksOf(NodeIndex count) {
  return (static_cast<std::size_t>(count) + NodeBlock::kSize - 1) /
         NodeBlock::kSize;
}

class PoseGraph {
 public:
  NodeIndex size() const { return size_; }
  // Gathered from where it is kept. Inlined, so that what the caller does not
  // use of it costs nothing.
  __attribute__((always_inline)) Node node(NodeIndex i) const {
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    Node node;
    if (block < packed_.size()) {
      const PackedColumns& packed = packed_[block];
      node.sequence = packed.at(kSequence, at);
      node.fraction = FromPackable(packed.at(kFraction, at));
      node.travelled_meters = FromPackable(packed.at(kTravelled, at));
      if (packed.at(kHasStamp, at) != 0) {
        node.stamp_ns = static_cast<std::int64_t>(packed.at(kStamp, at));
      }
    } else {
      const Record& record = records_[at];
      node.sequence = record.sequence;
      node.fraction = record.fraction;
      node.travelled_meters = record.travelled_meters;
      if (has_stamp_[at]) node.stamp_ns = record.stamp_ns;
    }
    node.pose = blocks_[block].pose(at);
    node.covariance = blocks_[block].covariance(at);
    return node;
  }
  Pose pose(NodeIndex i) const {
    return blocks_[Position(i) / NodeBlock::kSize].pose(Position(i) %
                                                        NodeBlock::kSize);
  }
  // Between two nodes, along the path.
  double MetersApart(NodeIndex i, NodeIndex j) const {
    return std::abs(TravelledMeters(i) - TravelledMeters(j));
  }
  // Nodes from k * NodeBlock::kSize on.
  const NodeBlock& block(std::size_t k) const { return blocks_[k]; }

  // The error transition from node i-1 to node i; identity for node 0 and where
  // none was given.
  ErrorTransition transition(NodeIndex i) const {
    ErrorTransition transition;
    if (!has_transitions_) return transition;
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    if (block >= packed_.size()) return transitions_[at];
    for (std::size_t k = 0; k < transition.values.size(); ++k) {
      transition.values[k] =
          FromPackable(packed_[block].at(kTransition + k, at));
    }
    return transition;
  }

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

  // Memory that nodes and edges take, without what an allocator adds. O(1).
  std::size_t bytes() const;

 private:
  // What is not in a block, of the nodes of the last one.
  struct Record {
    std::uint64_t sequence;
    double fraction;
    double travelled_meters;
    std::int64_t stamp_ns;
  };

  // The same of the blocks before it, which are full, as columns.
  enum PackedColumn : std::size_t {
    kSequence,
    kFraction,
    kTravelled,
    kHasStamp,
    kStamp,
    // One for each of its entries, if there are transitions.
    kTransition,
  };

  static std::size_t Position(NodeIndex i) {
    return static_cast<std::size_t>(i);
  }
  double TravelledMeters(NodeIndex i) const {
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    return block < packed_.size()
               ? FromPackable(packed_[block].at(kTravelled, at))
               : records_[at].travelled_meters;
  }
  // Nodes that memory is taken for at a time, in whole groups.
  std::size_t NodesAtATime() const;
  // The records, once there is one for every node of a block.
  void Pack();

  NodeIndex size_ = 0;
  bool has_transitions_ = false;
  std::vector<NodeBlock> blocks_;
  std::vector<PackedColumns> packed_;
  // Of the blocks that are full.
  std::size_t full_bytes_ = 0;
  std::vector<Record> records_;
  std::bitset<NodeBlock::kSize> has_stamp_;
  std::vector<ErrorTransition> transitions_;
  std::vector<NodeIndex> segment_starts_;
  std::unordered_map<NodeIndex, std::vector<NodeIndex>> loop_neighbours_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_GRAPH_POSE_GRAPH_H_
