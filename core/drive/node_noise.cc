#include "core/drive/node_noise.h"

#include <algorithm>

#include "core/geometry/state_matrix.h"
#include "core/noise/correlated_fixes.h"

namespace revisit::core {
namespace {

// Two nodes, without the transitions between them.
template <int D>
PathPair<D> PairOf(const PoseGraph& graph, const NoiseModel& noise,
                   NodeIndex earlier, NodeIndex later) {
  PathPair<D> pair;
  pair.earlier_pose = graph.pose(earlier);
  pair.later_pose = graph.pose(later);
  pair.earlier = ToMatrix<D>(graph.covariance(earlier));
  pair.later = ToMatrix<D>(graph.covariance(later));
  if (noise.decorrelates_over_way) {
    pair.meters_apart = graph.MetersApart(earlier, later);
  }
  return pair;
}

template <int D>
PathPair<D> PairOf(const PoseGraph& graph, const Correlation& correlation,
                   NodeIndex i, NodeIndex j) {
  const NoiseModel& noise = correlation.noise();
  const NodeIndex earlier = std::min(i, j);
  const NodeIndex later = std::max(i, j);
  PathPair<D> pair = PairOf<D>(graph, noise, earlier, later);
  if (noise.carries_transitions) {
    pair.transition = CarriedTransition<D>(graph, earlier, later);
  }
  return pair;
}

}  // namespace

template <int D>
StateMatrix<D> CarriedTransition(const PoseGraph& graph, NodeIndex earlier,
                                 NodeIndex later) {
  BackwardTransition<D> back;
  for (NodeIndex i = later; i > earlier && !back.decorrelated(); --i) {
    back.GoBack(graph.transition(i));
  }
  return back.psi();
}

template <int D>
StateMatrix<D> DifferenceCovariance(const PoseGraph& graph,
                                    const Correlation& correlation, NodeIndex i,
                                    NodeIndex j) {
  return DifferenceCovariance<D>(correlation,
                                 PairOf<D>(graph, correlation, i, j));
}

template <int D>
StateMatrix<D> CrossCovariance(const PoseGraph& graph,
                               const Correlation& correlation, NodeIndex i,
                               NodeIndex j) {
  const StateMatrix<D> later_with_earlier =
      CrossCovariance<D>(correlation, PairOf<D>(graph, correlation, i, j));
  if (j <= i) return later_with_earlier;
  return later_with_earlier.transpose();
}

template <int D>
StateMatrix<D> StepCovariance(const PoseGraph& graph,
                              const Correlation& correlation, NodeIndex i) {
  const NoiseModel& noise = correlation.noise();
  PathPair<D> step = PairOf<D>(graph, noise, i - 1, i);
  if (noise.carries_transitions) {
    step.transition = ToMatrix<D>(graph.transition(i));
  }
  return StepCovariance<D>(correlation, step);
}

bool FindUncorrelatedShares(const PoseGraph& graph,
                            const Correlation& correlation, NodeIndex query,
                            std::size_t k, BlockShares* shares) {
  if (!correlation.noise().decorrelates_over_way) return false;
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  const NodeIndex end =
      std::min(graph.size(), first + static_cast<NodeIndex>(NodeBlock::kSize));
  // No node of the block is nearer than its two ends, but where the query is
  // among them.
  if (query >= end && !(graph.MetersApart(end - 1, query) / correlation.meters <
                        kDecayedAway)) {
    return false;
  }
  const FixVariances of_query = FixVariancesOf(graph.covariance(query));
  shares->fill(1.0);
  for (NodeIndex i = first; i < end; ++i) {
    (*shares)[static_cast<std::size_t>(i - first)] =
        UncorrelatedShare(FixVariancesOf(graph.covariance(i)), of_query,
                          graph.MetersApart(i, query), correlation.meters);
  }
  return true;
}

template StateMatrix<3> CarriedTransition<3>(const PoseGraph&, NodeIndex,
                                             NodeIndex);
template StateMatrix<4> CarriedTransition<4>(const PoseGraph&, NodeIndex,
                                             NodeIndex);
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
template StateMatrix<3> StepCovariance<3>(const PoseGraph&, const Correlation&,
                                          NodeIndex);
template StateMatrix<4> StepCovariance<4>(const PoseGraph&, const Correlation&,
                                          NodeIndex);

}  // namespace revisit::core
