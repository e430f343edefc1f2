#include "core/graph/correlation.h"

#include <algorithm>

namespace revisit::core {

template <int D>
StateMatrix<D> PropagatedError(const PoseGraph& graph, CorrelationModel model,
                               NodeIndex earlier, NodeIndex later) {
  switch (model) {
    case CorrelationModel::kDeadReckoning:
      return DeadReckoningTransition<D>(graph.pose(earlier), graph.pose(later));
    case CorrelationModel::kIndependent:
      return StateMatrix<D>::Zero();
    case CorrelationModel::kFilter:
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
                                    CorrelationModel model, NodeIndex i,
                                    NodeIndex j) {
  const NodeIndex earlier = std::min(i, j);
  const NodeIndex later = std::max(i, j);
  const StateMatrix<D> earlier_covariance =
      ToMatrix<D>(graph.covariance(earlier));
  const StateMatrix<D> later_covariance = ToMatrix<D>(graph.covariance(later));
  if (model == CorrelationModel::kDeadReckoning) {
    return DeadReckoningDifferenceCovariance<D>(
        graph.pose(earlier), graph.pose(later), earlier_covariance,
        later_covariance);
  }
  return DifferenceCovariance<D>(
      earlier_covariance, later_covariance,
      PropagatedError<D>(graph, model, earlier, later));
}

template <int D>
StateMatrix<D> CrossCovariance(const PoseGraph& graph, CorrelationModel model,
                               NodeIndex i, NodeIndex j) {
  const NodeIndex earlier = std::min(i, j);
  const StateMatrix<D> carried =
      PropagatedError<D>(graph, model, earlier, std::max(i, j)) *
      ToMatrix<D>(graph.covariance(earlier));
  if (j == earlier) return carried;
  return carried.transpose();
}

template StateMatrix<3> PropagatedError<3>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);
template StateMatrix<4> PropagatedError<4>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);
template StateMatrix<3> DifferenceCovariance<3>(const PoseGraph&,
                                                CorrelationModel, NodeIndex,
                                                NodeIndex);
template StateMatrix<4> DifferenceCovariance<4>(const PoseGraph&,
                                                CorrelationModel, NodeIndex,
                                                NodeIndex);

template StateMatrix<3> CrossCovariance<3>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);
template StateMatrix<4> CrossCovariance<4>(const PoseGraph&, CorrelationModel,
                                           NodeIndex, NodeIndex);

}  // namespace revisit::core
