#include "core/candidates/same_place.h"

#include <cmath>
#include <cstdlib>

#include "core/candidates/posterior.h"
#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

double Apart(const PoseGraph& graph, NodeIndex i, NodeIndex j) {
  return std::abs(graph.node(i).travelled_meters -
                  graph.node(j).travelled_meters);
}

bool LoopJoins(const PoseGraph& graph, NodeIndex i, NodeIndex j) {
  const auto joins = [&](NodeIndex near_i) {
    for (const NodeIndex other : graph.LoopNeighbours(near_i)) {
      if (Apart(graph, other, j) <= kPlaceRadiusMeters) return true;
    }
    return false;
  };
  for (NodeIndex k = i; k >= 0 && Apart(graph, k, i) <= kPlaceRadiusMeters;
       --k) {
    if (joins(k)) return true;
  }
  for (NodeIndex k = i + 1;
       k < graph.size() && Apart(graph, k, i) <= kPlaceRadiusMeters; ++k) {
    if (joins(k)) return true;
  }
  return false;
}

}  // namespace

double SamePlaceProbability(const PoseGraph& graph, const RelativeModel& model,
                            NodeIndex i, NodeIndex j,
                            double log_likelihood_ratio) {
  if (Apart(graph, i, j) <= 2.0 * kPlaceRadiusMeters) return 0.0;
  const double turn =
      Difference(graph.node(i).pose, graph.node(j).pose).heading;
  if (std::abs(turn) <= 0.5 * kPi && LoopJoins(graph, i, j)) return 1.0;
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
