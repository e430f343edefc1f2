// Where the blocks of a graph lie and how certain their nodes are: a few
// numbers that show a search which blocks hold nothing it could use.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_BLOCK_BOUNDS_H_
#define REVISIT_CORE_DRIVE_BLOCK_BOUNDS_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"

namespace revisit::core {

struct NodeBounds {
  double least_x;
  double most_x;
  double least_y;
  double most_y;
  // Variances of the positions' errors in any direction.
  double least_variance;
  double most_variance;
};

// The bounds of nodes [first, last) of a block. REQUIRES: it has them, and
// there is one.
NodeBounds BoundsOf(const NodeBlock& block, std::size_t first,
                    std::size_t last);
// Lets the bounds hold for more nodes too.
void Join(const NodeBounds& more, NodeBounds* bounds);

// Bound to one graph: pass the same graph to every call. Between calls, nodes
// may be added to it and loop edges may change.
class BlockBounds {
 public:
  explicit BlockBounds(StateSpace state_space) : state_space_(state_space) {}

  // Adds the blocks that are now full and followed by at least two others.
  void Extend(const PoseGraph& graph);

  // Bounds are known of blocks [0, size()).
  std::size_t size() const { return blocks_.size(); }
  const NodeBounds& of_block(std::size_t k) const { return blocks_[k]; }

  // The bounds of blocks [first, end) as bytes. REQUIRES: end <= size().
  void SaveBlocks(std::size_t first, std::size_t end, ByteWriter* writer) const;
  // Adds `count` blocks that were saved; false if these are none: then throw
  // this away.
  bool LoadBlocks(std::size_t count, ByteReader* reader);

  // The first k such that in blocks [k, blocks) errors grow as those of dead
  // reckoning do: for each of their nodes j and the query q,
  //
  //   S_q - Psi(q, j) S_j Psi(q, j)^T
  //
  // is positive definite, and so is the covariance of their difference in the
  // form kGrown. `blocks` if it cannot be shown of any.
  // REQUIRES: blocks <= size(); the query lies after these blocks.
  std::size_t FirstGrowing(const PoseGraph& graph, NodeIndex query,
                           std::size_t blocks) const;

  // A disc about a point, in x and y, whose squared radius depends on the
  // variances of the node that it is compared with:
  //
  //   squared_per_variance (variance - least_taken l + most_added m)
  //
  // with l the least and m the greatest variance of the node's position in any
  // direction.
  struct Region {
    double x = 0.0;
    double y = 0.0;
    double squared_per_variance = 0.0;
    double variance = 0.0;
    double least_taken = 0.0;
    double most_added = 0.0;
  };
  // Whether any node with these bounds may lie within the region.
  static bool Near(const Region& region, const NodeBounds& bounds);
  // Calls visit(k) for the blocks of [first, last) that may hold nodes within
  // the region, in falling order.
  template <typename Visit>
  void VisitNear(const Region& region, std::size_t first, std::size_t last,
                 const Visit& visit) const {
    for (std::size_t group = (last + kGroup - 1) / kGroup; group-- > 0;) {
      const std::size_t begin = group * kGroup;
      if (begin + kGroup <= first) return;
      if (!Near(region, groups_[group])) continue;
      for (std::size_t k = begin + kGroup; k-- > begin;) {
        if (k >= first && k < last && Near(region, blocks_[k])) visit(k);
      }
    }
  }

  std::size_t bytes() const {
    return (blocks_.capacity() + groups_.capacity()) * sizeof(NodeBounds) +
           growing_since_.capacity() * sizeof(std::uint32_t);
  }

 private:
  // Blocks per group. A group has common bounds too, so that a search can pass
  // over all of its blocks at once.
  static constexpr std::size_t kGroup = 16;

  void Add(const NodeBounds& bounds);
  bool Grows(const PoseGraph& graph, std::size_t k) const;

  StateSpace state_space_;
  std::vector<NodeBounds> blocks_;
  std::vector<NodeBounds> groups_;
  // For each block k, the first block from which errors grow in all blocks up
  // to k; k + 1 if they do not grow in k itself.
  std::vector<std::uint32_t> growing_since_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_BLOCK_BOUNDS_H_
