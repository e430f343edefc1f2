#include "core/search/alignment/relation.h"

#include <cassert>

#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

Pose Relation::Difference(const SimilarityModel& model, const Pose& query,
                          const Pose& matched) const {
  return PassDifference(model, query, matched);
}

template <int D>
StateMatrix<D> Relation::CovarianceOf(const Query& query,
                                      const Correlation& correlation,
                                      NodeIndex j) const {
  return DifferenceCovariance<D>(query.graph, correlation, query.node, j);
}

template StateMatrix<3> Relation::CovarianceOf<3>(const Query&,
                                                  const Correlation&,
                                                  NodeIndex) const;
template StateMatrix<4> Relation::CovarianceOf<4>(const Query&,
                                                  const Correlation&,
                                                  NodeIndex) const;

bool Relation::FindShares(const Query& query, const Correlation& correlation,
                          std::size_t k, BlockShares* shares) const {
  return FindUncorrelatedShares(query.graph, correlation, query.node, k,
                                shares);
}

ErrorTransition Relation::TransitionTowards(const Query& query,
                                            NodeIndex i) const {
  return query.graph.transition(i);
}

// Most queries lie well behind their history, but sequences may be short.
std::size_t Relation::BlocksBefore(const Query& query,
                                   NodeIndex history_size) const {
  assert(history_size <= query.node);
  constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
  std::size_t blocks =
      static_cast<std::size_t>(history_size) / NodeBlock::kSize;
  while (blocks > 0 &&
         (static_cast<NodeIndex>(blocks) + 1) * kBlock + kBlock / 2 >
             query.node) {
    --blocks;
  }
  return blocks;
}

std::size_t Relation::FirstGrowing(const Query& query,
                                   const BlockBounds& bounds,
                                   std::size_t blocks) const {
  return bounds.FirstGrowing(query.graph, query.node, blocks);
}

}  // namespace revisit::core
