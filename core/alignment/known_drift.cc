#include "core/alignment/known_drift.h"

#include <Eigen/Cholesky>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"
#include "core/graph/correlation.h"

namespace revisit::core {

Direction DirectionOf(const PoseGraph& graph, const ConfirmedLoop& loop) {
  const double turn =
      Difference(graph.node(loop.query).pose, graph.node(loop.matched).pose)
          .heading;
  return std::abs(turn) > 0.5 * kPi ? Direction::kOpposite : Direction::kSame;
}

template <int D>
KnownDrift<D>::KnownDrift(const PoseGraph& graph, const SimilarityModel& model,
                          const ConfirmedLoop& loop, NodeIndex query)
    : graph_(graph),
      loop_(loop),
      variance_scale_(model.inflation * model.inflation) {
  assert(model.correlation == CorrelationModel::kDeadReckoning);
  SimilarityModel closure = model;
  closure.tolerance = kConfirmedTolerance;
  closure.direction = DirectionOf(graph, loop);
  query_part_ =
      CrossCovariance<D>(graph, model.correlation, query, loop.query) -
      CrossCovariance<D>(graph, model.correlation, query, loop.matched);
  const StateMatrix<D> covariance = ToleratedCovariance<D>(
      closure, DifferenceCovariance<D>(graph, model.correlation, loop.query,
                                       loop.matched));
  information_ =
      Eigen::LDLT<StateMatrix<D>>(covariance).solve(StateMatrix<D>::Identity());
  loop_difference_ = ToVector<D>(PassDifference(
      closure, graph.node(loop.query).pose, graph.node(loop.matched).pose));
}

template <int D>
void KnownDrift<D>::Apply(NodeIndex j, StateVector<D>* difference,
                          StateMatrix<D>* covariance) const {
  constexpr CorrelationModel kModel = CorrelationModel::kDeadReckoning;
  const StateMatrix<D> x =
      variance_scale_ *
      (query_part_ - CrossCovariance<D>(graph_, kModel, j, loop_.query) +
       CrossCovariance<D>(graph_, kModel, j, loop_.matched));
  const StateMatrix<D> gain = x * information_;
  *difference -= gain * loop_difference_;
  (*difference)(D - 1) = WrapHeading((*difference)(D - 1));
  *covariance -= gain * x.transpose();
}

template class KnownDrift<3>;
template class KnownDrift<4>;

}  // namespace revisit::core
