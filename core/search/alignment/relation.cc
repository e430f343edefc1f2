#include "core/search/alignment/relation.h"

#include <cassert>
#include <cmath>
#include <utility>

#include "core/geometry/frame_transform.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

namespace {

// Each is made once: a search of many drives has a relation to each of them.
const std::vector<FrameWay>& WaysOf(const FrameRelation& tie) {
  static const auto* const kUnknown =
      new std::vector<FrameWay>{{0.0, 1.0, true}};
  static const auto* const kTold =
      new std::vector<FrameWay>{{std::log1p(-kTailShare), 1.0, false},
                                {std::log(kTailShare), kTailVariance, false}};
  static const auto* const kShown =
      new std::vector<FrameWay>{{0.0, 1.0, false}};
  if (!tie.is_tied()) return *kUnknown;
  const bool is_told =
      tie.state == FrameState::kAfter || tie.state == FrameState::kDatum;
  return is_told ? *kTold : *kShown;
}

}  // namespace

Relation::Relation(const RelatedFrames& frames, const FrameRelation& tie,
                   std::vector<WeighedDrift> drifts)
    : other_(std::make_shared<const Other>(
          Other{frames, tie, &WaysOf(tie), std::move(drifts)})) {}

Pose Relation::InHistory(const Pose& pose) const {
  if (is_own() || !other_->tie.is_tied()) return pose;
  return Compose(Inverse(other_->tie.transform), pose);
}

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
std::size_t Relation::BlocksBefore(const Query& query, NodeIndex end) const {
  constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
  std::size_t blocks = static_cast<std::size_t>(end) / NodeBlock::kSize;
  if (!is_own()) return blocks;
  assert(end <= query.node);
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
