// The similarity of one query node with a block of nodes, many at a time, with
// the widest vectors of the machine that this runs on.
//
// Gamma in closed form, LDL^T and the test for ill-conditioned covariances
// equal those of DeadReckoningDifferenceCovariance() and Evaluate() operation
// by operation, in double precision without fused multiply-add. Results differ
// between machines, and from Evaluate(), only in the last digit of the
// logarithm.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SIMILARITY_KERNEL_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SIMILARITY_KERNEL_H_

#include <array>
#include <bitset>
#include <cstddef>
#include <cstdint>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

// How Gamma of nodes in another frame depends on each of them
// (frame_relation.h): node_scale S_j + L_j M L_j^T, with the entries of M in
// the order of the state, and L the identity at this place.
struct TiedTerms {
  double node_scale = 1.0;
  double x = 0.0;
  double y = 0.0;
  double swung[4][4] = {};
};

// The query that all nodes are compared with, and how.
struct KernelQuery {
  // Heading in (-pi, pi].
  Pose pose;
  Covariance covariance;
  StateSpace state_space = StateSpace::kPlanar;
  // kGrown, or kSummed with the shares 1 - r that come with a block.
  DifferenceForm form = DifferenceForm::kGrown;
  // Whether headings of the block are turned by pi.
  bool opposite = false;
  // Multiplies Gamma.
  double variance_scale = 1.0;
  // Added to the diagonal of the result.
  double position_variance = 0.0;
  double heading_variance = 0.0;
  // c, the factor of d^T Gamma^-1 d.
  double exponent = 0.5;
  // For nodes in another frame, or null; of FindDifferences() only. There the
  // covariance is C, all that Gamma has beside these terms, and neither form
  // nor variance_scale counts.
  const TiedTerms* tied = nullptr;
};

// One entry per node of a block.
struct alignas(64) BlockSimilarity {
  std::array<double, NodeBlock::kSize> log_similarity;
  std::array<double, NodeBlock::kSize> squared_mahalanobis;
};

// Finds the similarity with all nodes of the block, kImpossible where
// ill-conditioned. For kGrown, the query is the later node of each pair. `next`
// is the block that will be asked for next, which is fetched on the way, or the
// same block. `shares`, if not null, multiply Gamma node by node: aligned, and
// for kSummed.
void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, const BlockShares* shares,
                   BlockSimilarity* similarity);

using BlockColumn = std::array<double, NodeBlock::kSize>;

// Entries of the lower triangle of a symmetric matrix, stored row by row.
inline constexpr std::size_t kMostEntries = 10;

// The query less each node of a block, in the order of the state (x, y, z if
// spatial, heading), and the covariance of this difference.
struct alignas(64) DifferenceBlock {
  std::array<BlockColumn, 4> difference;
  std::array<BlockColumn, kMostEntries> covariance;
  // Entries from here on are of no interest.
  std::size_t count = NodeBlock::kSize;
};

// Entries [first, last) of a block, in whole groups of NodeBlock::kGroupSize.
struct EntryRange {
  std::size_t first = 0;
  std::size_t last = NodeBlock::kSize;
};

// Finds the differences that EvaluateBlock() evaluates, of these entries.
void FindDifferences(const KernelQuery& query, const NodeBlock& block,
                     const NodeBlock& next, const BlockShares* shares,
                     DifferenceBlock* differences,
                     const EntryRange& range = {});

// The inputs of KnownDrift::Apply(), in the order of the state.
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

// KnownDrift::Apply() for these nodes of a block, whose indices in the graph
// are `indices`. Where the covariance that is left would be ill-conditioned,
// nothing changes.
void TakeKnownDrift(const KnownDriftTerms& terms, StateSpace state_space,
                    const NodeBlock& block, const BlockColumn& indices,
                    DifferenceBlock* differences, const EntryRange& range = {});

// Evaluates the differences as they are, with exponent 1/2. kImpossible where
// ill-conditioned.
void EvaluateDifferences(StateSpace state_space,
                         const DifferenceBlock& differences,
                         BlockSimilarity* similarity);

// How difference k of a block is changed before it is evaluated: row[k] of
// `certainty` (kMostEntries per row) is subtracted from its covariance, and
// shift k, turned about z by the angle of this cosine and sine, is added to it.
struct DifferenceChange {
  // Groups of NodeBlock::kGroupSize entries of which none is of interest.
  std::bitset<NodeBlock::kSize / NodeBlock::kGroupSize> left_out;
  const double* certainty = nullptr;
  double cosine = 1.0;
  double sine = 0.0;
  // Least share of the covariance that has to be left; where less would be
  // left, the difference stays as it is.
  double least_left = 0.0;
  alignas(64) std::array<std::int64_t, NodeBlock::kSize> row;
  std::array<BlockColumn, 4> shift;
};

// Evaluates the differences once changed. `similarity` holds the results of
// EvaluateDifferences(), which stay where a changed difference would be
// ill-conditioned, and in groups that are left out.
void EvaluateChanged(StateSpace state_space, const DifferenceBlock& differences,
                     const DifferenceChange& change,
                     BlockSimilarity* similarity);

// Bounds for any change that EvaluateChanged() may be given. Entries are those
// of lower triangles, as in DifferenceBlock.
struct ChangeBound {
  // A shift s costs the path at least 1/2 s^T shift^-1 s elsewhere.
  double shift[kMostEntries] = {};
  // No more than this is subtracted from a covariance.
  double certainty[kMostEntries] = {};
  // DifferenceChange::least_left.
  double least_left = 0.0;
};

// For each node, an upper bound on the log-similarity that EvaluateChanged()
// can find, less what the shift costs. `similarity` holds the results of
// EvaluateDifferences(); `most` need not be aligned. `unshifted`: an upper
// bound on -1/2 ln|G| of all covariances G that it can find, infinite where it
// may leave a difference as it is; null or as `most`.
void BoundChanged(StateSpace state_space, const DifferenceBlock& differences,
                  const ChangeBound& bound, const BlockSimilarity& similarity,
                  BlockColumn* most, BlockColumn* unshifted);

// The nodes near a query: those with
//   r^2 <= squared_per_variance (d^T C d / r^2 + variance),
// where d is the way from the node to the query in x and y, r its length and C
// its covariance.
struct NodeRegion {
  double x = 0.0;
  double y = 0.0;
  double squared_per_variance = 0.0;
  double variance = 0.0;
  // C is this covariance of the query, plus the node's times node_scale.
  double xx = 0.0;
  double xy = 0.0;
  double yy = 0.0;
  double node_scale = 0.0;
};

// Whether any node of a full block is near or not a number.
bool HoldsNear(const NodeRegion& region, const NodeBlock& block);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SIMILARITY_KERNEL_H_
