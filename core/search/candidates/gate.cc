// The gate alone: which candidates are accepted is decided in verdict.cc.
#include "core/search/candidates/gate.h"

#include <cassert>
#include <optional>

#include "core/drive/node_noise.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"

namespace revisit::core {
namespace {

template <int D>
GatedDifference DecideIn(const Query& query, const History& history,
                         const SimilarityModel& model, const Gate& gate,
                         NodeIndex matched) {
  GatedDifference result;
  result.difference = history.relation.Difference(
      model, query.graph.pose(query.node), history.graph.pose(matched));
  const StateMatrix<D> gamma =
      history.relation.CovarianceOf<D>(query, model.correlation, matched);
  result.covariance =
      ToCovariance<D>((model.inflation * model.inflation) * gamma);
  const std::optional<QuadraticForm> terms = Evaluate<D>(
      ToleratedCovariance<D>(model, gamma), ToVector<D>(result.difference));
  result.gate =
      terms ? gate.Decide(terms->squared_mahalanobis) : gate.IllConditioned();
  return result;
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

GatedDifference DecideAt(const Query& query, const History& history,
                         const SimilarityModel& model, const Gate& gate,
                         NodeIndex matched) {
  return model.state_space == StateSpace::kPlanar
             ? DecideIn<3>(query, history, model, gate, matched)
             : DecideIn<4>(query, history, model, gate, matched);
}

}  // namespace revisit::core
