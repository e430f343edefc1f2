// The similarity of one query node with a block of nodes, many at a time: with
// the widest vectors of the machine it runs on.
//
// Gamma in closed form, LDL^T and what counts as ill-conditioned are those of
// DeadReckoningDifferenceCovariance() and Evaluate(), operation by operation,
// in double precision without fused multiply-add: machines differ from each
// other, and from Evaluate(), in the logarithm alone, by its last digit.
#ifndef REVISIT_CORE_ALIGNMENT_SIMILARITY_KERNEL_H_
#define REVISIT_CORE_ALIGNMENT_SIMILARITY_KERNEL_H_

#include <array>
#include <cstddef>
#include <cstdint>

#include "core/geometry/pose.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// What all nodes are compared with.
struct KernelQuery {
  // Heading in (-pi, pi].
  Pose pose;
  Covariance covariance;
  StateSpace state_space = StateSpace::kPlanar;
  // Errors of dead reckoning; else independent ones.
  bool dead_reckoning = true;
  // Headings of the block are turned by pi.
  bool opposite = false;
  // Multiplies Gamma.
  double variance_scale = 1.0;
  // Added to the diagonal then.
  double position_variance = 0.0;
  double heading_variance = 0.0;
  // Of d^T Gamma^-1 d, c.
  double exponent = 0.5;
};

// One entry a node of a block.
struct alignas(64) BlockSimilarity {
  std::array<double, NodeBlock::kSize> log_similarity;
  std::array<double, NodeBlock::kSize> squared_mahalanobis;
};

// Of all nodes of the block; kImpossible where ill-conditioned. For dead
// reckoning, the query is the later node of each pair. `next` is the block that
// will be asked for next, or the same again: it is fetched on the way.
void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, BlockSimilarity* similarity);

using BlockColumn = std::array<double, NodeBlock::kSize>;

// Row by row, the lower triangle of a symmetric matrix.
inline constexpr std::size_t kMostEntries = 10;

// The query less each node of a block, in the order of the state (x, y, z if
// spatial, heading), and the covariance of that.
struct alignas(64) DifferenceBlock {
  std::array<BlockColumn, 4> difference;
  std::array<BlockColumn, kMostEntries> covariance;
};

// What EvaluateBlock() evaluates.
void FindDifferences(const KernelQuery& query, const NodeBlock& block,
                     const NodeBlock& next, DifferenceBlock* differences);

// What KnownDrift::Apply() needs, in the order of the state.
struct KnownDriftTerms {
  struct LoopNode {
    NodeIndex index = 0;
    double x = 0.0;
    double y = 0.0;
    double covariance[4][4] = {};
  };
  LoopNode query;
  LoopNode matched;
  double query_part[4][4] = {};
  double information[4][4] = {};
  double loop_difference[4] = {};
  double variance_scale = 1.0;
};

// KnownDrift::Apply() for the nodes of a block, `first` on, where what is left
// of the covariance is well-conditioned; elsewhere nothing changes.
void TakeKnownDrift(const KnownDriftTerms& terms, StateSpace state_space,
                    const NodeBlock& block, NodeIndex first,
                    DifferenceBlock* differences);

// Evaluate() of differences as they are. kImpossible where ill-conditioned;
// the exponent is 1/2.
void EvaluateDifferences(StateSpace state_space,
                         const DifferenceBlock& differences,
                         BlockSimilarity* similarity);

// How each difference is changed before it is evaluated, by entry k of
// `change`: row change[k] of `certainty` (kMostEntries a row) is taken from the
// covariance, and the shift, turned by the angle of this cosine and sine about
// z, is added to the difference.
struct DifferenceChange {
  const double* certainty = nullptr;
  double cosine = 1.0;
  double sine = 0.0;
  // Share of the covariance that has to be left, or nothing is changed.
  double least_left = 0.0;
  alignas(64) std::array<std::int64_t, NodeBlock::kSize> row;
  std::array<BlockColumn, 4> shift;
};

// Where `similarity`, which has what EvaluateDifferences() says, is possible
// unchanged but not changed, it stays as it is.
void EvaluateChanged(StateSpace state_space, const DifferenceBlock& differences,
                     const DifferenceChange& change,
                     BlockSimilarity* similarity);

// A bound of what EvaluateChanged() can make of differences, whatever it takes
// and shifts: entries as the lower triangle of a DifferenceBlock.
struct ChangeBound {
  // Shifts s cost at least 1/2 s^T shift^-1 s elsewhere.
  double shift[kMostEntries] = {};
  // No more than this is taken from a covariance.
  double certainty[kMostEntries] = {};
  // As DifferenceChange has it.
  double least_left = 0.0;
};

// For each node the most that EvaluateChanged() can say of it, less what the
// shift costs. `similarity` has what EvaluateDifferences() says; `most` need
// not be aligned.
void BoundChanged(StateSpace state_space, const DifferenceBlock& differences,
                  const ChangeBound& bound, const BlockSimilarity& similarity,
                  BlockColumn* most);

// Nodes that lie near enough to a query: with d the way from the node to it in
// x and y, r its length and C the covariance of d,
//   r^2 <= squared_per_variance (d^T C d / r^2 + variance).
struct NodeRegion {
  double x = 0.0;
  double y = 0.0;
  double squared_per_variance = 0.0;
  double variance = 0.0;
  // C: the query's, and the node's times this.
  double xx = 0.0;
  double xy = 0.0;
  double yy = 0.0;
  double node_scale = 0.0;
};

// Whether any node of a full block does, or is not a number.
bool HoldsNear(const NodeRegion& region, const NodeBlock& block);

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SIMILARITY_KERNEL_H_
