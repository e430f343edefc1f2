#include "core/alignment/known_drift.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"
#include "core/graph/correlation.h"

namespace revisit::core {

Direction DirectionOf(const PoseGraph& graph, const ConfirmedLoop& loop) {
  const double turn =
      Difference(graph.pose(loop.query), graph.pose(loop.matched)).heading;
  return std::abs(turn) > 0.5 * kPi ? Direction::kOpposite : Direction::kSame;
}

namespace {

template <int D>
bool PositiveDefinite(const StateMatrix<D>& m) {
  return Evaluate<D>(m, StateVector<D>::Zero()).has_value();
}

// Whether the error at the later node can be the error at the earlier one,
// carried on, plus new noise.
template <int D>
bool GrowsForward(const PoseGraph& graph, NodeIndex a, NodeIndex b) {
  const Node earlier = graph.node(std::min(a, b));
  const Node later = graph.node(std::max(a, b));
  const StateMatrix<D> psi =
      DeadReckoningTransition<D>(earlier.pose, later.pose);
  StateMatrix<D> added =
      ToMatrix<D>(later.covariance) -
      psi * ToMatrix<D>(earlier.covariance) * psi.transpose();
  AddTolerance<D>(kConfirmedTolerance, &added);
  return PositiveDefinite<D>(added);
}

}  // namespace

template <int D>
std::optional<KnownDrift<D>> KnownDrift<D>::Make(const PoseGraph& graph,
                                                 const SimilarityModel& model,
                                                 const ConfirmedLoop& loop,
                                                 NodeIndex query) {
  assert(model.correlation == CorrelationModel::kDeadReckoning);
  if (!GrowsForward<D>(graph, loop.matched, loop.query) ||
      !GrowsForward<D>(graph, std::max(loop.matched, loop.query), query)) {
    return std::nullopt;
  }
  SimilarityModel closure = model;
  closure.tolerance = kConfirmedTolerance;
  closure.direction = DirectionOf(graph, loop);
  const StateMatrix<D> covariance = ToleratedCovariance<D>(
      closure, DifferenceCovariance<D>(graph, model.correlation, loop.query,
                                       loop.matched));
  if (!PositiveDefinite<D>(covariance)) return std::nullopt;
  KnownDrift known(graph, loop, model.inflation * model.inflation);
  known.query_part_ =
      CrossCovariance<D>(graph, model.correlation, query, loop.query) -
      CrossCovariance<D>(graph, model.correlation, query, loop.matched);
  known.information_ =
      Eigen::LDLT<StateMatrix<D>>(covariance).solve(StateMatrix<D>::Identity());
  known.loop_difference_ = ToVector<D>(PassDifference(
      closure, graph.pose(loop.query), graph.pose(loop.matched)));
  return known;
}

template <int D>
KnownDriftTerms KnownDrift<D>::Terms() const {
  const auto rows = [](const StateMatrix<D>& m, double(&to)[4][4]) {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) to[r][c] = m(r, c);
    }
  };
  KnownDriftTerms terms;
  const auto fill = [&](NodeIndex i, KnownDriftTerms::LoopNode* to) {
    const Node node = graph_->node(i);
    to->index = i;
    to->x = node.pose.x;
    to->y = node.pose.y;
    rows(ToMatrix<D>(node.covariance), to->covariance);
  };
  fill(loop_.query, &terms.query);
  fill(loop_.matched, &terms.matched);
  rows(query_part_, terms.query_part);
  rows(information_, terms.information);
  for (int r = 0; r < D; ++r) terms.loop_difference[r] = loop_difference_(r);
  terms.variance_scale = variance_scale_;
  return terms;
}

template <int D>
void KnownDrift<D>::Apply(NodeIndex j, StateVector<D>* difference,
                          StateMatrix<D>* covariance) const {
  constexpr CorrelationModel kModel = CorrelationModel::kDeadReckoning;
  const StateMatrix<D> x =
      variance_scale_ *
      (query_part_ - CrossCovariance<D>(*graph_, kModel, j, loop_.query) +
       CrossCovariance<D>(*graph_, kModel, j, loop_.matched));
  const StateMatrix<D> gain = x * information_;
  *difference -= gain * loop_difference_;
  (*difference)(D - 1) = WrapHeading((*difference)(D - 1));
  *covariance -= gain * x.transpose();
}

template class KnownDrift<3>;
template class KnownDrift<4>;

}  // namespace revisit::core
