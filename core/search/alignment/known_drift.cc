#include "core/search/alignment/known_drift.h"

#include <Eigen/Cholesky>
#include <cassert>

#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

template <int D>
LoopEnd<D> EndAt(const PoseGraph& graph, NodeIndex i) {
  const Node node = graph.node(i);
  return {i, node.pose, ToMatrix<D>(node.covariance)};
}

template <int D>
bool GrowsForward(const LoopEnd<D>& a, const LoopEnd<D>& b,
                  const StateMatrix<D>& tolerance) {
  const LoopEnd<D>& earlier = b.index < a.index ? b : a;
  const LoopEnd<D>& later = b.index < a.index ? a : b;
  const StateMatrix<D> psi =
      DeadReckoningTransition<D>(earlier.pose, later.pose);
  StateMatrix<D> added =
      later.covariance - psi * earlier.covariance * psi.transpose();
  added += tolerance;
  return IsPositiveDefinite<D>(added);
}

template <int D>
StateMatrix<D> KnownDrift<D>::Closure::Tolerance() const {
  if (measurement) return *measurement;
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(kConfirmedTolerance, &tolerance);
  return tolerance;
}

template <int D>
auto KnownDrift<D>::Measured(const ConfirmedLoop& loop) -> Closure {
  const MeasuredLoop& measured = *loop.measured;
  const PoseEstimate carried = CarriedToQuery<D>(measured);
  return {
      {loop.query, measured.query.pose, ToMatrix<D>(measured.query.covariance)},
      {loop.matched, carried.pose, ToMatrix<D>(carried.covariance)},
      ToVector<D>(Difference(measured.query.pose, carried.pose)),
      MeasurementCovariance<D>(measured)};
}

template <int D>
auto KnownDrift<D>::Unmeasured(const PoseGraph& graph, SimilarityModel model,
                               const ConfirmedLoop& loop) -> Closure {
  model.direction = DirectionOf(graph, loop);
  return {EndAt<D>(graph, loop.query), EndAt<D>(graph, loop.matched),
          ToVector<D>(PassDifference(model, graph.pose(loop.query),
                                     graph.pose(loop.matched))),
          std::nullopt};
}

template <int D>
StateMatrix<D> KnownDrift<D>::CrossWith(NodeIndex i,
                                        const LoopEnd<D>& end) const {
  const Pose pose = graph_->pose(i);
  if (i > end.index) {
    return DeadReckoningTransition<D>(end.pose, pose) * end.covariance;
  }
  const StateMatrix<D> carried = DeadReckoningTransition<D>(pose, end.pose) *
                                 ToMatrix<D>(graph_->covariance(i));
  return carried.transpose();
}

template <int D>
std::optional<KnownDrift<D>> KnownDrift<D>::Make(const Query& query,
                                                 const SimilarityModel& model,
                                                 const ConfirmedLoop& loop) {
  assert(model.correlation.noise().closures_show_drift);
  if (loop.measured) {
    if (auto known = Make(query, model, Measured(loop))) return known;
  }
  return Make(query, model, Unmeasured(query.graph, model, loop));
}

template <int D>
std::optional<KnownDrift<D>> KnownDrift<D>::Make(const Query& query,
                                                 const SimilarityModel& model,
                                                 const Closure& closure) {
  const LoopEnd<D>& c = closure.query;
  const LoopEnd<D>& m = closure.matched;
  // The pose of a closure at the query's own node may lie behind it.
  const LoopEnd<D>& last = m.index > c.index ? m : c;
  const StateMatrix<D> tolerance = closure.Tolerance();
  if (!GrowsForward<D>(m, c, tolerance) ||
      !(last.index == query.node ||
        GrowsForward<D>(last, EndAt<D>(query.graph, query.node), tolerance))) {
    return std::nullopt;
  }
  const bool c_is_later = c.index > m.index;
  const LoopEnd<D>& earlier = c_is_later ? m : c;
  const LoopEnd<D>& later = c_is_later ? c : m;
  StateMatrix<D> covariance =
      (model.inflation * model.inflation) *
      DeadReckoningDifferenceCovariance<D>(
          earlier.pose, later.pose, earlier.covariance, later.covariance);
  covariance += tolerance;
  if (!IsPositiveDefinite<D>(covariance)) return std::nullopt;
  KnownDrift known(query.graph, closure, model.inflation * model.inflation);
  known.query_part_ =
      known.CrossWith(query.node, c) - known.CrossWith(query.node, m);
  known.information_ =
      Eigen::LDLT<StateMatrix<D>>(covariance).solve(StateMatrix<D>::Identity());
  return known;
}

template <int D>
KnownDriftTerms KnownDrift<D>::Terms() const {
  KnownDriftTerms terms;
  terms.query = LoopNodeOf<D>(closure_.query);
  terms.matched = LoopNodeOf<D>(closure_.matched);
  FillRows<D>(query_part_, terms.query_part);
  FillRows<D>(information_, terms.information);
  for (int r = 0; r < D; ++r) terms.loop_difference[r] = closure_.difference(r);
  terms.variance_scale = variance_scale_;
  return terms;
}

template <int D>
void KnownDrift<D>::Apply(NodeIndex j, StateVector<D>* difference,
                          StateMatrix<D>* covariance) const {
  const StateMatrix<D> x =
      variance_scale_ * (query_part_ - CrossWith(j, closure_.query) +
                         CrossWith(j, closure_.matched));
  const StateMatrix<D> gain = x * information_;
  *difference -= gain * closure_.difference;
  (*difference)(D - 1) = WrapHeading((*difference)(D - 1));
  *covariance -= gain * x.transpose();
}

template LoopEnd<3> EndAt<3>(const PoseGraph&, NodeIndex);
template LoopEnd<4> EndAt<4>(const PoseGraph&, NodeIndex);
template bool GrowsForward<3>(const LoopEnd<3>&, const LoopEnd<3>&,
                              const StateMatrix<3>&);
template bool GrowsForward<4>(const LoopEnd<4>&, const LoopEnd<4>&,
                              const StateMatrix<4>&);
template class KnownDrift<3>;
template class KnownDrift<4>;

}  // namespace revisit::core
