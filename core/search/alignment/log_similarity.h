// How well two nodes agree, under the uncertainty of their difference (paper,
// Eq. 2):
//
//   lambda(i,j) = -1/2 ln|Gamma_ij + R| - c d^T (Gamma_ij + R)^-1 d,
//
// d = x_i - x_j with heading wrapped, R the place tolerance. c = 1/2 makes it
// the log density of a Gaussian less a constant; the paper prints c = 1.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_LOG_SIMILARITY_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_LOG_SIMILARITY_H_

#include <algorithm>
#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/comparison.h"
#include "core/noise/noise_model.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// Log-similarity of the impossible: Gamma is not positive definite in double
// precision, or no path leads to the node.
inline constexpr double kImpossible = -std::numeric_limits<double>::infinity();

// lambda(i,j) of two nodes in any order; kImpossible if ill-conditioned. O(1)
// where the noise model has a closed form, else O(|i - j|).
double LogSimilarity(const PoseGraph& graph, const SimilarityModel& model,
                     NodeIndex i, NodeIndex j);

// lambda(query, i) for all i in [0, count): a column of the trellis. O(count)
// in every noise model. Where it has a closed form, the kernel computes it
// (similarity_kernel.h). REQUIRES: count <= query.
void LogSimilarityColumn(const PoseGraph& graph, const SimilarityModel& model,
                         NodeIndex query, NodeIndex count,
                         std::vector<double>* column);

// A query node as the kernel takes it. REQUIRES: the noise model has a
// closed form.
KernelQuery MakeKernelQuery(const PoseGraph& graph,
                            const SimilarityModel& model, NodeIndex query);

// Calls visit(first, part) for the nodes of [0, count) block by block. Entry k
// of a part is the similarity of node first + k; entries from node `count` on
// are undefined. REQUIRES: count <= query; the noise model has a
// closed form.
template <typename Visit>
void VisitBlockSimilarities(const PoseGraph& graph,
                            const SimilarityModel& model, NodeIndex query,
                            NodeIndex count, const Visit& visit) {
  const KernelQuery kernel_query = MakeKernelQuery(graph, model, query);
  const std::size_t blocks = BlocksOf(count);
  BlockSimilarity part;
  alignas(64) BlockShares shares;
  for (std::size_t k = 0; k < blocks; ++k) {
    const bool shared =
        FindUncorrelatedShares(graph, model.correlation, query, k, &shares);
    // After the last block comes the first, with the next query.
    EvaluateBlock(kernel_query, graph.block(k),
                  graph.block(k + 1 < blocks ? k + 1 : 0),
                  shared ? &shares : nullptr, &part);
    visit(static_cast<NodeIndex>(k * NodeBlock::kSize), part);
  }
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_LOG_SIMILARITY_H_
