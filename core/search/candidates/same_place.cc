#include "core/search/candidates/same_place.h"

#include <algorithm>
#include <cmath>

#include "core/drive/node_range.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
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

bool LinkJoins(const RelatedFrames& frames,
               const std::vector<ConfirmedLoop>& links, NodeIndex i,
               NodeIndex j) {
  return std::any_of(links.begin(), links.end(),
                     [&](const ConfirmedLoop& link) {
                       return frames.asking.graph.MetersApart(link.query, i) <=
                                  kPlaceRadiusMeters &&
                              frames.other.graph.MetersApart(link.matched, j) <=
                                  kPlaceRadiusMeters;
                     });
}

double ProbabilityOf(const RelativeModel& model, double log_prior,
                     double log_likelihood_ratio) {
  const double log_odds =
      log_prior +
      ShapeWeight(model.shape, model.spacing_meters) * log_likelihood_ratio;
  return 1.0 / (1.0 + std::exp(-log_odds));
}

// Whether two headings are those of one direction.
bool FaceAlike(double a, double b) {
  return std::abs(WrapHeading(a - b)) <= 0.5 * kPi;
}

template <int D>
double SimilarityAcross(const RelatedFrames& frames,
                        const FrameRelation& relation,
                        const SimilarityModel& model, NodeIndex i,
                        NodeIndex j) {
  const FramePair<D> pair(frames, relation, i, model.inflation);
  const Pose pose = frames.other.graph.pose(j);
  StateMatrix<D> gamma =
      pair.Covariance(j, pose, ToMatrix<D>(frames.other.graph.covariance(j)));
  AddTolerance<D>(model.tolerance, &gamma);
  const auto terms =
      Evaluate<D>(gamma, ToVector<D>(Difference(pair.query(), pose)));
  if (!terms) return kImpossible;
  return -0.5 * (terms->log_determinant + terms->squared_mahalanobis);
}

}  // namespace

double SamePlaceProbability(const PoseGraph& graph, const RelativeModel& model,
                            NodeIndex i, NodeIndex j,
                            double log_likelihood_ratio,
                            std::optional<double> known_scale) {
  if (graph.MetersApart(i, j) <= 2.0 * kPlaceRadiusMeters) return 0.0;
  if (graph.has_loop_edges() &&
      DirectionOf(graph, {i, j}) == Direction::kSame &&
      LoopJoins(graph, i, j)) {
    return 1.0;
  }
  SimilarityModel anchor = model.similarity;
  anchor.inflation = known_scale.value_or(anchor.inflation);
  anchor.form = LikelihoodForm::kGaussian;
  anchor.direction = Direction::kSame;
  const double similarity = LogSimilarity(graph, anchor, i, j);
  if (similarity == kImpossible) return 0.0;
  return ProbabilityOf(model, similarity + LogNewPlaceTerm(model),
                       log_likelihood_ratio);
}

double SamePlaceAcross(const RelatedFrames& frames,
                       const FrameRelation& relation,
                       const std::vector<ConfirmedLoop>& links,
                       const RelativeModel& model, NodeIndex i, NodeIndex j,
                       double log_likelihood_ratio) {
  if (!relation.is_tied()) {
    return ProbabilityOf(model, -LogWorldNodes(model), log_likelihood_ratio);
  }
  const double turned =
      relation.transform.heading + frames.other.graph.pose(j).heading;
  const PoseGraph& graph = frames.asking.graph;
  if (FaceAlike(graph.pose(i).heading, turned) &&
      (frames.are_of_one_drive()
           ? graph.has_loop_edges() && LoopJoins(graph, i, j)
           : LinkJoins(frames, links, i, j))) {
    return 1.0;
  }
  const double similarity =
      model.similarity.state_space == StateSpace::kPlanar
          ? SimilarityAcross<3>(frames, relation, model.similarity, i, j)
          : SimilarityAcross<4>(frames, relation, model.similarity, i, j);
  if (similarity == kImpossible) return 0.0;
  return ProbabilityOf(model, similarity + LogNewPlaceTerm(model),
                       log_likelihood_ratio);
}

}  // namespace revisit::core
