// The gate alone: which candidates are accepted is decided in verdict.cc.
#include "core/search/candidates/gate.h"

#include <cassert>
#include <optional>

#include "core/drive/frame_relation.h"
#include "core/drive/node_noise.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"

namespace revisit::core {
namespace {

// `gamma` is inflated.
template <int D>
GatedDifference DecideOn(const Pose& difference, const StateMatrix<D>& gamma,
                         const StateMatrix<D>& tolerated, const Gate& gate) {
  GatedDifference result;
  result.difference = difference;
  result.covariance = ToCovariance<D>(gamma);
  const std::optional<QuadraticForm> terms =
      Evaluate<D>(tolerated, ToVector<D>(difference));
  result.gate =
      terms ? gate.Decide(terms->squared_mahalanobis) : gate.IllConditioned();
  return result;
}

template <int D>
GatedDifference DecideInPast(const Query& query, const History& history,
                             const SimilarityModel& model, const Gate& gate,
                             NodeIndex matched) {
  const StateMatrix<D> gamma =
      history.relation.CovarianceOf<D>(query, model.correlation, matched);
  return DecideOn<D>(
      history.relation.Difference(model, query.graph.pose(query.node),
                                  history.graph.pose(matched)),
      (model.inflation * model.inflation) * gamma,
      ToleratedCovariance<D>(model, gamma), gate);
}

template <int D>
GatedDifference DecideAcross(const Query& query, const History& history,
                             const SimilarityModel& model, const Gate& gate,
                             NodeIndex matched, const FrameRelation& tie,
                             double fixed_scale) {
  const FramePair<D> pair(history.relation.frames(), tie, query.node,
                          model.inflation, fixed_scale);
  const Pose pose = history.graph.pose(matched);
  const StateMatrix<D> gamma =
      Turned<D>(pair.Covariance(matched, pose,
                                ToMatrix<D>(history.graph.covariance(matched))),
                tie.transform.heading);
  StateMatrix<D> tolerated = gamma;
  AddTolerance<D>(model.tolerance, &tolerated);
  return DecideOn<D>(PassDifference(model, query.graph.pose(query.node),
                                    Compose(tie.transform, pose)),
                     gamma, tolerated, gate);
}

template <int D>
std::optional<GatedDifference> DecideIn(const Query& query,
                                        const History& history,
                                        const SimilarityModel& model,
                                        const Gate& gate, NodeIndex matched,
                                        std::size_t way) {
  const Relation& relation = history.relation;
  if (relation.is_own()) {
    return DecideInPast<D>(query, history, model, gate, matched);
  }
  const std::size_t ways = relation.ways().size();
  if (way >= ways) {
    return DecideAcross<D>(
        query, history, model, gate, matched,
        relation.Shown(relation.drifts()[way - ways], model.inflation), 1.0);
  }
  if (relation.ways()[way].is_unknown) return std::nullopt;
  return DecideAcross<D>(query, history, model, gate, matched, relation.tie(),
                         relation.ways()[way].fixed_scale);
}

GateResult Compare(double squared_mahalanobis, double degrees_of_freedom,
                   double threshold) {
  GateResult result;
  result.squared_mahalanobis = squared_mahalanobis;
  result.degrees_of_freedom = degrees_of_freedom;
  result.threshold = threshold;
  result.p_value = ChiSquaredAbove(degrees_of_freedom, squared_mahalanobis);
  result.verdict = squared_mahalanobis <= threshold ? GateVerdict::kAccepted
                                                    : GateVerdict::kRejected;
  return result;
}

}  // namespace

Gate::Gate(StateSpace space, double probability)
    : degrees_of_freedom_(DegreesOfFreedom(space)), probability_(probability) {
  assert(probability > 0.0 && probability < 1.0);
  threshold_ = ChiSquaredQuantile(degrees_of_freedom_, probability);
}

GateResult Gate::DecidePath(double squared_mahalanobis,
                            double degrees_of_freedom) const {
  return Compare(squared_mahalanobis, degrees_of_freedom,
                 ChiSquaredQuantile(degrees_of_freedom, probability_));
}

GateResult Gate::Decide(double squared_mahalanobis) const {
  return Compare(squared_mahalanobis, degrees_of_freedom_, threshold_);
}

GateResult Gate::IllConditioned() const {
  GateResult result;
  result.degrees_of_freedom = degrees_of_freedom_;
  result.threshold = threshold_;
  return result;
}

std::optional<GatedDifference> DecideAt(const Query& query,
                                        const History& history,
                                        const SimilarityModel& model,
                                        const Gate& gate, NodeIndex matched,
                                        std::size_t way) {
  return model.state_space == StateSpace::kPlanar
             ? DecideIn<3>(query, history, model, gate, matched, way)
             : DecideIn<4>(query, history, model, gate, matched, way);
}

}  // namespace revisit::core
