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

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SIMILARITY_KERNEL_H_
