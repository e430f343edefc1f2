#include "core/drive/correlation.h"

#include <algorithm>
#include <cassert>
#include <cmath>

namespace revisit::core {
namespace {

// exp(-kDecayedAway) is nothing beside 1 in double precision.
constexpr double kDecayedAway = 37.0;

// The ratio of the geometric to the arithmetic mean.
double RatioOfMeans(double a, double b) {
  return 2.0 * std::sqrt(a / (a + b)) * std::sqrt(b / (a + b));
}

double HorizontalVariance(const Covariance& covariance) {
  return covariance(0, 0) + covariance(1, 1);
}

}  // namespace

double UncorrelatedShare(const Covariance& a, const Covariance& b,
                         double meters_apart, const Correlation& correlation) {
  const double decayed = meters_apart / correlation.meters;
  if (!(decayed < kDecayedAway)) return 1.0;
  const double alike =
      std::min({1.0, RatioOfMeans(HorizontalVariance(a), HorizontalVariance(b)),
                RatioOfMeans(a(3, 3), b(3, 3))});
  // Without cancellation for neighbours, which nearly share their error.
  return (1.0 - alike) - alike * std::expm1(-decayed);
}

bool FindUncorrelatedShares(const PoseGraph& graph,
                            const Correlation& correlation, NodeIndex query,
                            std::size_t k, BlockShares* shares) {
  if (correlation.model != CorrelationModel::kCorrelatedFixes) return false;
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  const NodeIndex end =
      std::min(graph.size(), first + static_cast<NodeIndex>(NodeBlock::kSize));
  // No node of the block is nearer than its two ends, but where the query is
  // among them.
  if (query >= end && !(graph.MetersApart(end - 1, query) / correlation.meters <
                        kDecayedAway)) {
    return false;
  }
  const Covariance of_query = graph.covariance(query);
  shares->fill(1.0);
  for (NodeIndex i = first; i < end; ++i) {
    (*shares)[static_cast<std::size_t>(i - first)] =
        UncorrelatedShare(graph.covariance(i), of_query,
                          graph.MetersApart(i, query), correlation);
  }
  return true;
}

template <int D>
StateMatrix<D> PropagatedError(const PoseGraph& graph, CorrelationModel model,
                               NodeIndex earlier, NodeIndex later) {
  assert(model != CorrelationModel::kCorrelatedFixes);
  switch (model) {
    case CorrelationModel::kDeadReckoning:
      return DeadReckoningTransition<D>(graph.pose(earlier), graph.pose(later));
    case CorrelationModel::kIndependent:
      return StateMatrix<D>::Zero();
    case CorrelationModel::kFilter:
    case CorrelationModel::kCorrelatedFixes:
      break;
  }
  // Backward from the later node, so that the product can stop as soon as the
  // errors have decorrelated.
  StateMatrix<D> psi = StateMatrix<D>::Identity();
  for (NodeIndex i = later; i > earlier; --i) {
    psi *= ToMatrix<D>(graph.transition(i));
    if (psi.template lpNorm<Eigen::Infinity>() < kDecorrelatedNorm) {
      return StateMatrix<D>::Zero();
    }
  }
  return psi;
}

template <int D>
StateMatrix<D> DifferenceCovariance(const PoseGraph& graph,
                                    const Correlation& correlation, NodeIndex i,
                                    NodeIndex j) {
  const NodeIndex earlier = std::min(i, j);
  const NodeIndex later = std::max(i, j);
  const StateMatrix<D> earlier_covariance =
      ToMatrix<D>(graph.covariance(earlier));
  const StateMatrix<D> later_covariance = ToMatrix<D>(graph.covariance(later));
  if (correlation.model == CorrelationModel::kDeadReckoning) {
    return DeadReckoningDifferenceCovariance<D>(
        graph.pose(earlier), graph.pose(later), earlier_covariance,
        later_covariance);
  }
  if (correlation.model == CorrelationModel::kCorrelatedFixes) {
    return UncorrelatedShare(graph.covariance(earlier), graph.covariance(later),
                             graph.MetersApart(i, j), correlation) *
           (earlier_covariance + later_covariance);
  }
  return DifferenceCovariance<D>(
      earlier_covariance, later_covariance,
      PropagatedError<D>(graph, correlation.model, earlier, later));
}

template <int D>
StateMatrix<D> CrossCovariance(const PoseGraph& graph,
                               const Correlation& correlation, NodeIndex i,
                               NodeIndex j) {
  if (correlation.model == CorrelationModel::kCorrelatedFixes) {
    const Covariance a = graph.covariance(i);
    const Covariance b = graph.covariance(j);
    const double r =
        1.0 - UncorrelatedShare(a, b, graph.MetersApart(i, j), correlation);
    return 0.5 * r * (ToMatrix<D>(a) + ToMatrix<D>(b));
  }
  const NodeIndex earlier = std::min(i, j);
  const StateMatrix<D> carried =
      PropagatedError<D>(graph, correlation.model, earlier, std::max(i, j)) *
      ToMatrix<D>(graph.covariance(earlier));
  if (j == earlier) return carried;
  return carried.transpose();
}

template StateMatrix<3> PropagatedError<3>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);
template StateMatrix<4> PropagatedError<4>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);
template StateMatrix<3> DifferenceCovariance<3>(const PoseGraph&,
                                                const Correlation&, NodeIndex,
                                                NodeIndex);
template StateMatrix<4> DifferenceCovariance<4>(const PoseGraph&,
                                                const Correlation&, NodeIndex,
                                                NodeIndex);

template StateMatrix<3> CrossCovariance<3>(const PoseGraph&, const Correlation&,
                                           NodeIndex, NodeIndex);
template StateMatrix<4> CrossCovariance<4>(const PoseGraph&, const Correlation&,
                                           NodeIndex, NodeIndex);

}  // namespace revisit::core
