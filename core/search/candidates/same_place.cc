#include "core/search/candidates/same_place.h"

#include <cmath>

#include "core/drive/node_range.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/candidates/posterior.h"

namespace revisit::core {
namespace {

bool LoopJoins(const PoseGraph& graph, NodeIndex i, NodeIndex j) {
  const auto joins = [&](NodeIndex near_i) {
    for (const NodeIndex other : graph.LoopNeighbours(near_i)) {
      if (graph.MetersApart(other, j) <= kPlaceRadiusMeters) return true;
    }
    return false;
  };
  for (NodeIndex k = i; k >= 0 && graph.MetersApart(k, i) <= kPlaceRadiusMeters;
       --k) {
    if (joins(k)) return true;
  }
  for (NodeIndex k = i + 1;
       k < graph.size() && graph.MetersApart(k, i) <= kPlaceRadiusMeters; ++k) {
    if (joins(k)) return true;
  }
  return false;
}

}  // namespace

double SamePlaceProbability(const PoseGraph& graph, const RelativeModel& model,
                            NodeIndex i, NodeIndex j,
                            double log_likelihood_ratio) {
  if (graph.MetersApart(i, j) <= 2.0 * kPlaceRadiusMeters) return 0.0;
  if (graph.has_loop_edges() &&
      DirectionOf(graph, {i, j}) == Direction::kSame &&
      LoopJoins(graph, i, j)) {
    return 1.0;
  }
  SimilarityModel anchor = model.similarity;
  anchor.form = LikelihoodForm::kGaussian;
  anchor.direction = Direction::kSame;
  const double similarity = LogSimilarity(graph, anchor, i, j);
  if (similarity == kImpossible) return 0.0;
  const double log_odds =
      similarity + LogNewPlaceTerm(model) +
      ShapeWeight(model.shape, model.spacing_meters) * log_likelihood_ratio;
  return 1.0 / (1.0 + std::exp(-log_odds));
}

}  // namespace revisit::core
