// The noise of a graph's nodes: core/noise speaks of two poses of a path, and
// this finds what it asks for of two nodes.
#ifndef REVISIT_CORE_DRIVE_NODE_NOISE_H_
#define REVISIT_CORE_DRIVE_NODE_NOISE_H_

#include <array>
#include <cstddef>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/covariances.h"
#include "core/noise/filter.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// Psi(later, earlier) of the transitions that the nodes carry. O(later -
// earlier). REQUIRES: earlier <= later.
template <int D>
StateMatrix<D> CarriedTransition(const PoseGraph& graph, NodeIndex earlier,
                                 NodeIndex later);

// Gamma of two nodes in any order. O(1) where the model has a closed form, else
// O(|i - j|).
template <int D>
StateMatrix<D> DifferenceCovariance(const PoseGraph& graph,
                                    const Correlation& correlation, NodeIndex i,
                                    NodeIndex j);

// S_ij, the cross-covariance of two nodes in any order. Takes as long.
template <int D>
StateMatrix<D> CrossCovariance(const PoseGraph& graph,
                               const Correlation& correlation, NodeIndex i,
                               NodeIndex j);

// Drift and jitter of the step from node i - 1 to node i (covariances.h). O(1).
template <int D>
StateMatrix<D> StepCovariance(const PoseGraph& graph,
                              const Correlation& correlation, NodeIndex i);

// 1 - r of the nodes of block k against the query, where errors decorrelate
// over the way (correlated_fixes.h). Returns false, and leaves them as they
// are, where all of them are 1: the errors have decorrelated, as they have in
// any other model that sums covariances.
using BlockShares = std::array<double, NodeBlock::kSize>;
bool FindUncorrelatedShares(const PoseGraph& graph,
                            const Correlation& correlation, NodeIndex query,
                            std::size_t k, BlockShares* shares);

// Calls visit(i, Gamma) for the query node and each node i in [0, count), in
// any order. O(query) in every model. REQUIRES: count <= query.
template <int D, typename Visit>
void VisitDifferenceCovariances(const PoseGraph& graph,
                                const Correlation& correlation, NodeIndex query,
                                NodeIndex count, const Visit& visit) {
  if (correlation.noise().has_closed_form()) {
    for (NodeIndex i = 0; i < count; ++i) {
      visit(i, DifferenceCovariance<D>(graph, correlation, i, query));
    }
    return;
  }
  const StateMatrix<D> query_covariance = ToMatrix<D>(graph.covariance(query));
  // One product, run backward from the query past every node.
  BackwardTransition<D> back;
  std::vector<ErrorTransition> transitions;
  for (NodeIndex i = query; i >= 0; --i) {
    if (i < count) {
      visit(i, DifferenceCovariance<D>(ToMatrix<D>(graph.covariance(i)),
                                       query_covariance, back.psi()));
    }
    if (back.decorrelated() || i == 0) continue;
    const std::size_t at = static_cast<std::size_t>(i) % NodeBlock::kSize;
    if (i == query || at + 1 == NodeBlock::kSize) {
      graph.ReadTransitions(static_cast<std::size_t>(i) / NodeBlock::kSize,
                            &transitions);
    }
    back.GoBack(transitions[at]);
  }
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_NODE_NOISE_H_
