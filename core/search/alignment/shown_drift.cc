#include "core/search/alignment/shown_drift.h"

#include <Eigen/Cholesky>
#include <cassert>
#include <limits>

#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/noise/dead_reckoning.h"
#include "core/search/alignment/known_drift.h"

namespace revisit::core {

template <int D>
std::optional<ShownDrift<D>> ShownDrift<D>::Make(
    const Query& query, const SimilarityModel& model,
    const std::vector<ConfirmedLoop>& pairs) {
  assert(model.correlation.noise().closures_show_drift);
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(kConfirmedTolerance, &tolerance);
  const LoopEnd<D> end = EndAt<D>(query.graph, query.node);
  ShownDrift shown(query.graph, model);
  for (const ConfirmedLoop& pair : pairs) {
    assert(pair.matched < pair.query && pair.query <= query.node);
    const LoopEnd<D> c = EndAt<D>(query.graph, pair.query);
    if (GrowsForward<D>(EndAt<D>(query.graph, pair.matched), c, tolerance) &&
        GrowsForward<D>(c, end, tolerance)) {
      shown.Learn(pair);
    }
  }
  if (!shown.tie_) return std::nullopt;
  return shown;
}

template <int D>
StateMatrix<D> ShownDrift<D>::AddedOver(const ConfirmedLoop& pair) const {
  const LoopEnd<D> c = EndAt<D>(*graph_, pair.query);
  const LoopEnd<D> m = EndAt<D>(*graph_, pair.matched);
  return variance_scale() *
         (c.covariance - Swung<D>(m.covariance, m.pose, c.pose));
}

template <int D>
FrameRelation ShownDrift<D>::AsClaimed(const ConfirmedLoop& pair) const {
  FrameRelation claimed;
  claimed.state = FrameState::kSame;
  claimed.place = graph_->pose(pair.matched);
  claimed.fixed = ToMatrix<4>(ToCovariance<D>(
      Swung<D>(AddedOver(pair), graph_->pose(pair.query), claimed.place)));
  claimed.asking_node = pair.query;
  claimed.other_node = pair.matched;
  return claimed;
}

template <int D>
std::optional<FrameRelation> ShownDrift<D>::Updated(const FrameRelation& tie,
                                                    const ConfirmedLoop& pair,
                                                    bool may_contradict) const {
  const Pose matched = graph_->pose(pair.matched);
  Pose seen = graph_->pose(pair.query);
  if (DirectionOf(*graph_, pair) == Direction::kOpposite) {
    seen.heading = WrapHeading(seen.heading + kPi);
  }
  const Pose placed = Compose(tie.transform, matched);
  const StateMatrix<D> prior =
      ErrorOfMatched<D>(nodes(), tie, pair, model_.inflation);
  StateMatrix<D> sum = prior;
  AddTolerance<D>(kConfirmedTolerance, &sum);
  const StateVector<D> innovation = ToVector<D>(Difference(seen, placed));
  const auto distance = Evaluate<D>(sum, innovation);
  const double most = may_contradict ? MostOfAgreeing(D)
                                     : std::numeric_limits<double>::infinity();
  if (!distance || distance->squared_mahalanobis > most) return std::nullopt;
  FrameRelation updated;
  updated.state = FrameState::kSame;
  Correct<D>(matched, placed, innovation, prior, sum, &updated);
  updated.place = matched;
  updated.asking_node = pair.query;
  updated.other_node = pair.matched;
  return updated;
}

template <int D>
void ShownDrift<D>::Learn(const ConfirmedLoop& pair) {
  std::optional<FrameRelation> updated;
  if (tie_) updated = Updated(*tie_, pair, /*may_contradict=*/true);
  if (!updated) updated = Updated(AsClaimed(pair), pair, false);
  if (updated) tie_ = *updated;
}

template <int D>
KnownDriftTerms ShownDrift<D>::Bridge() const {
  const ConfirmedLoop newest{*tie_->asking_node, *tie_->other_node, nullptr};
  const LoopEnd<D> c = EndAt<D>(*graph_, newest.query);
  const LoopEnd<D> m = EndAt<D>(*graph_, newest.matched);
  KnownDriftTerms terms;
  // With these, the kernel's X is Psi(j, m) S_m Psi(c, m)^T - S_j Psi^T, which
  // is -Q_j Psi^T.
  terms.query = LoopNodeOf<D>(c);
  terms.matched = LoopNodeOf<D>(
      {m.index, m.pose,
       m.covariance * DeadReckoningTransition<D>(m.pose, c.pose).transpose()});
  const StateMatrix<D> known =
      AddedOver(newest) +
      Swung<D>(Turned<D>(ToMatrix<D>(ToCovariance<4>(tie_->fixed)),
                         -tie_->transform.heading),
               m.pose, c.pose);
  FillRows<D>(
      Eigen::LDLT<StateMatrix<D>>(known).solve(StateMatrix<D>::Identity()),
      terms.information);
  const StateVector<D> shown = ToVector<D>(
      Difference(c.pose, Compose(Inverse(tie_->transform), c.pose)));
  for (int r = 0; r < D; ++r) terms.loop_difference[r] = shown(r);
  terms.variance_scale = variance_scale();
  return terms;
}

template class ShownDrift<3>;
template class ShownDrift<4>;

}  // namespace revisit::core
