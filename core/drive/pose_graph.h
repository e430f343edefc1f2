// The pose graph of one vehicle: nodes spaced evenly by travelled distance,
// edges between consecutive nodes and for confirmed loop closures.
//
// Indices are dense and grow with the travelled distance. Edges are undirected.
// Where the trajectory jumped, consecutive nodes have no edge; the nodes
// between two jumps form a segment.
//
// A copy of a graph is a view of it as it was: it takes little, since the two
// share all full blocks, and stays the same while the graph grows.
//
// Thread-compatible: const calls may run at the same time. A graph and its
// copies count as different objects.
#ifndef REVISIT_CORE_DRIVE_POSE_GRAPH_H_
#define REVISIT_CORE_DRIVE_POSE_GRAPH_H_

#include <array>
#include <bitset>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/node_index.h"
#include "core/drive/packed_columns.h"
#include "core/geometry/pose.h"

namespace revisit::core {

struct Node {
  // The last pose at or before the node, and the fraction in [0, 1) of the way
  // to the next pose at which the node lies.
  std::uint64_t sequence = 0;
  double fraction = 0.0;
  std::optional<std::int64_t> stamp_ns;
  // Distance travelled up to the node, without jumps.
  double travelled_meters = 0.0;
  // Heading in (-pi, pi].
  Pose pose;
  Covariance covariance;
};

// The poses and covariances of up to 128 nodes, laid out for kernels that read
// many nodes at once: in groups of eight nodes, and in each group one row per
// quantity, in which the eight nodes stand side by side. The other fields of a
// node are kept elsewhere.
class NodeBlock {
 public:
  static constexpr std::size_t kSize = 128;
  static constexpr std::size_t kGroupSize = 8;

  // Rows of a group. The rows from kZ on exist only if spatial().
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

  // Row of the covariance's entry (r, c) over (x, y, z, heading).
  static constexpr Row CovarianceRow(int r, int c) {
    constexpr Row kRows[] = {kXX, kXY, kXZ, kXH, kYY, kYZ, kYH, kZZ, kZH, kHH};
    return kRows[Covariance::Index(r, c)];
  }

  // Whether z or one of its covariances is not 0 for some node.
  bool spatial() const { return spatial_; }
  std::size_t rows() const { return spatial_ ? kSpatialRows : kPlanarRows; }
  // Number of groups. Entries beyond the last node are 0.
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
    const auto at_row = [entry](Row row) { return entry[row * kGroupSize]; };
    Covariance covariance;
    covariance.upper = {at_row(kXX), at_row(kXY), 0.0,         at_row(kXH),
                        at_row(kYY), 0.0,         at_row(kYH), 0.0,
                        0.0,         at_row(kHH)};
    if (spatial_) {
      covariance(0, 2) = at_row(kXZ);
      covariance(1, 2) = at_row(kYZ);
      covariance(2, 2) = at_row(kZZ);
      covariance(2, 3) = at_row(kZH);
    }
    return covariance;
  }

  // Begins to fetch the first rows of a node's group, if there is one, for a
  // call soon after: histories of which few nodes are read are in no cache.
  void Prefetch(std::size_t at, std::size_t first_rows) const {
    const std::size_t line = at / kGroupSize * rows();
    if (line + first_rows > lines_.size()) return;
    for (std::size_t row = 0; row < first_rows; ++row) {
      __builtin_prefetch(&lines_[line + row]);
    }
  }

  // Adds a node. Memory is allocated for this many groups at a time.
  // REQUIRES: at < kSize is the number of nodes so far.
  void Add(std::size_t at, const Pose& pose, const Covariance& covariance,
           std::size_t groups_at_a_time);

  // Copies a node of another block. REQUIRES: at < kSize is at most the number
  // of nodes so far.
  void Copy(const NodeBlock& from, std::size_t from_at, std::size_t at);

  std::size_t bytes() const { return lines_.capacity() * sizeof(Line); }

  void Save(ByteWriter* writer) const;
  // Becomes what was saved. False, and unspecified, unless these are `nodes`
  // nodes of finite values.
  bool Load(std::size_t nodes, ByteReader* reader);

 private:
  struct alignas(64) Line {
    std::array<double, kGroupSize> entries{};
  };

  void BecomeSpatial();

  std::vector<Line> lines_;
  bool spatial_ = false;
};

// Number of blocks that hold the first `count` nodes.
inline std::size_t BlocksOf(NodeIndex count) {
  return (static_cast<std::size_t>(count) + NodeBlock::kSize - 1) /
         NodeBlock::kSize;
}

// Copies take O(blocks + edges + segments): 16 bytes for each full block, and
// the last one whole.
class PoseGraph {
 public:
  NodeIndex size() const { return size_; }
  // Always inlined, so that fields that the caller does not use cost nothing.
  __attribute__((always_inline)) Node node(NodeIndex i) const {
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    Node node;
    if (block < full_.size()) {
      const PackedColumns& packed = full_[block]->packed;
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
    const NodeBlock& nodes = this->block(block);
    node.pose = nodes.pose(at);
    node.covariance = nodes.covariance(at);
    return node;
  }
  Pose pose(NodeIndex i) const {
    return block(Position(i) / NodeBlock::kSize)
        .pose(Position(i) % NodeBlock::kSize);
  }
  Covariance covariance(NodeIndex i) const {
    return block(Position(i) / NodeBlock::kSize)
        .covariance(Position(i) % NodeBlock::kSize);
  }
  // Begins to fetch what pose() and covariance() of a node read.
  void Prefetch(NodeIndex i) const {
    const NodeBlock& nodes = block(Position(i) / NodeBlock::kSize);
    nodes.Prefetch(Position(i) % NodeBlock::kSize, nodes.rows());
  }
  // Distance between two nodes along the path.
  double MetersApart(NodeIndex i, NodeIndex j) const {
    return std::abs(TravelledMeters(i) - TravelledMeters(j));
  }
  // Block k holds the nodes from k * NodeBlock::kSize on.
  const NodeBlock& block(std::size_t k) const {
    return k < full_.size() ? full_[k]->nodes : last_;
  }

  // The error transition from node i - 1 to node i; the identity for node 0 and
  // where none was given.
  ErrorTransition transition(NodeIndex i) const {
    ErrorTransition transition;
    if (!has_transitions_) return transition;
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    if (block >= full_.size()) return transitions_[at];
    const PackedColumns& packed = full_[block]->packed;
    for (std::size_t k = 0; k < transition.values.size(); ++k) {
      transition.values[k] = FromPackable(packed.at(kTransition + k, at));
    }
    return transition;
  }

  // Reads the transitions of all nodes of block k, in order: faster than
  // calling transition() for each.
  void ReadTransitions(std::size_t k,
                       std::vector<ErrorTransition>* transitions) const;

  // First node of the segment that holds node i.
  NodeIndex SegmentStart(NodeIndex i) const;
  // First node after the segment that holds node i; size() if it is the last.
  NodeIndex SegmentEnd(NodeIndex i) const;

  // The last node at or before the pose, or nothing if there is none.
  std::optional<NodeIndex> NodeAtOrBefore(std::uint64_t sequence) const;

  bool has_loop_edges() const { return !loop_neighbours_.empty(); }
  // Whether a loop-closure edge joins two of the nodes [first, end). O(1 + loop
  // edges), without a copy of them.
  bool HasLoopEdgeAmong(NodeIndex first, NodeIndex end) const;

  // Other ends of the loop-closure edges at node i, in the order in which the
  // edges were added.
  const std::vector<NodeIndex>& LoopNeighbours(NodeIndex i) const;

  // Every loop-closure edge once as (from, to) with from < to, sorted.
  std::vector<std::pair<NodeIndex, NodeIndex>> LoopEdges() const;

  // A node that starts a segment has no edge to the node before. `transition`
  // is for vehicles whose filter reports error transitions: give it for all
  // nodes or for none.
  void AddNode(const Node& node, bool starts_segment,
               const std::optional<ErrorTransition>& transition);

  // Adds an edge between two different nodes. Two nodes may have more than one
  // edge (as many as loop closures between them); each counts for the degree.
  void AddLoopEdge(NodeIndex a, NodeIndex b);
  // Removes one edge between the two nodes. Returns whether there was one.
  bool RemoveLoopEdge(NodeIndex a, NodeIndex b);

  // Memory of nodes and edges, without the allocator's overhead. O(1).
  std::size_t bytes() const;

  // ---- The nodes as bytes. Loop-closure edges are not among them.

  // Blocks [0, full_blocks()) never change again.
  std::size_t full_blocks() const { return full_.size(); }
  // REQUIRES: first <= end <= full_blocks().
  void SaveBlocks(std::size_t first, std::size_t end, ByteWriter* writer) const;
  // The nodes from block `first` on. REQUIRES: first <= full_blocks().
  void SaveRest(std::size_t first, ByteWriter* writer) const;
  // Adds `count` blocks that were saved, and the rest behind them. False if
  // these are not so many blocks, or not such as a graph with, or without,
  // transitions could have: then throw the graph away. REQUIRES: all nodes of
  // the graph have come by LoadBlocks().
  bool LoadBlocks(std::size_t count, bool transitions, ByteReader* reader);
  bool LoadRest(bool transitions, ByteReader* reader);

 private:
  // The fields of a node that are not in its block, for nodes of the last
  // block.
  struct Record {
    std::uint64_t sequence;
    double fraction;
    double travelled_meters;
    std::int64_t stamp_ns;
  };

  // Columns of the same fields for the full blocks before it.
  enum PackedColumn : std::size_t {
    kSequence,
    kFraction,
    kTravelled,
    kHasStamp,
    kStamp,
    // One column per entry of the matrix, if there are transitions.
    kTransition,
  };

  // A block to which no node will be added.
  struct FullBlock {
    NodeBlock nodes;
    PackedColumns packed;
  };

  static std::size_t Position(NodeIndex i) {
    return static_cast<std::size_t>(i);
  }
  double TravelledMeters(NodeIndex i) const {
    const std::size_t block = Position(i) / NodeBlock::kSize;
    const std::size_t at = Position(i) % NodeBlock::kSize;
    return block < full_.size()
               ? FromPackable(full_[block]->packed.at(kTravelled, at))
               : records_[at].travelled_meters;
  }
  // Number of nodes for which memory is allocated at a time: whole groups.
  std::size_t NodesAtATime() const;
  // Packs the records of the last block, once it is full, and puts it to the
  // full ones.
  void Pack();
  void AddFullBlock(NodeBlock nodes, PackedColumns packed);
  static std::size_t PackedColumnCount(bool transitions) {
    return kTransition + (transitions ? ErrorTransition{}.values.size() : 0);
  }
  void SaveSegmentStarts(std::size_t first, std::size_t end,
                         ByteWriter* writer) const;
  // Adds those of nodes [size_, end).
  bool LoadSegmentStarts(NodeIndex end, ByteReader* reader);
  // Whether nodes from `first` on may follow those before them.
  bool IsOrdered(NodeIndex first) const;

  NodeIndex size_ = 0;
  bool has_transitions_ = false;
  std::vector<std::shared_ptr<const FullBlock>> full_;
  // Memory of the full blocks.
  std::size_t full_bytes_ = 0;
  // The nodes behind the full blocks.
  NodeBlock last_;
  std::vector<Record> records_;
  std::bitset<NodeBlock::kSize> has_stamp_;
  std::vector<ErrorTransition> transitions_;
  std::vector<NodeIndex> segment_starts_;
  std::unordered_map<NodeIndex, std::vector<NodeIndex>> loop_neighbours_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_POSE_GRAPH_H_
