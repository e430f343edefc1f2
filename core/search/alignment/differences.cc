#include "core/search/alignment/differences.h"

#include <algorithm>
#include <cassert>
#include <numeric>

#include "core/drive/confirmed_loop.h"
#include "core/drive/node_noise.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

template <int D>
Differences<D>::Differences(const PoseGraph& graph,
                            const SimilarityModel& model,
                            const std::optional<ConfirmedLoop>& last_confirmed,
                            NodeIndex query)
    : graph_(graph),
      query_(query),
      model_(model),
      has_closed_form_(model.correlation.noise().has_closed_form()),
      next_(query) {
  if (!has_closed_form_) return;
  kernel_query_ = MakeKernelQuery(graph, model_, query);
  if (last_confirmed) {
    if (const auto known =
            KnownDrift<D>::Make(graph, model_, *last_confirmed, query)) {
      known_drift_ = known->Terms();
    }
  }
}

template <int D>
void Differences<D>::Find(std::size_t k, std::size_t count, std::size_t next,
                          DifferenceBlock* differences) {
  differences->count = NodeBlock::kSize;
  if (!has_closed_form_) {
    FindFiltered(k, count, differences);
  } else {
    alignas(64) BlockShares shares;
    const bool shared =
        FindUncorrelatedShares(graph_, model_.correlation, query_, k, &shares);
    FindDifferences(kernel_query_, graph_.block(k), graph_.block(next),
                    shared ? &shares : nullptr, differences);
    if (known_drift_) {
      alignas(64) BlockColumn indices;
      std::iota(indices.begin(), indices.end(),
                static_cast<double>(k * NodeBlock::kSize));
      TakeKnownDrift(*known_drift_, model_.state_space, graph_.block(k),
                     indices, differences);
    }
  }
  for (auto& column : differences->difference) {
    std::fill(column.begin() + static_cast<int>(count), column.end(), 0.0);
  }
}

template <int D>
void Differences<D>::FindAmong(const NodeBlock& nodes,
                               const BlockColumn& indices, std::size_t count,
                               DifferenceBlock* differences) {
  differences->count = count;
  assert(model_.correlation.noise().neighbours_err_alike);
  FindDifferences(kernel_query_, nodes, nodes, nullptr, differences);
  if (known_drift_) {
    TakeKnownDrift(*known_drift_, model_.state_space, nodes, indices,
                   differences);
  }
}

template <int D>
void Differences<D>::FindFiltered(std::size_t k, std::size_t count,
                                  DifferenceBlock* differences) {
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  const Pose query_pose = graph_.pose(query_);
  const StateMatrix<D> query_covariance =
      ToMatrix<D>(graph_.covariance(query_));
  for (std::size_t i = count; i-- > 0;) {
    const NodeIndex j = first + static_cast<NodeIndex>(i);
    CarryBackTo(j);
    const Node node = graph_.node(j);
    const StateMatrix<D> covariance = ToleratedCovariance<D>(
        model_, DifferenceCovariance<D>(ToMatrix<D>(node.covariance),
                                        query_covariance, back_.psi()));
    const StateVector<D> difference =
        ToVector<D>(PassDifference(model_, query_pose, node.pose));
    std::size_t entry = 0;
    for (int r = 0; r < D; ++r) {
      differences->difference[static_cast<std::size_t>(r)][i] = difference(r);
      for (int c = 0; c <= r; ++c) {
        differences->covariance[entry++][i] = covariance(r, c);
      }
    }
  }
}

// One product of transitions runs backward from the query past every node.
template <int D>
void Differences<D>::CarryBackTo(NodeIndex j) {
  for (; next_ > j && !back_.decorrelated(); --next_) {
    back_.GoBack(graph_.transition(next_));
  }
}

template class Differences<3>;
template class Differences<4>;

}  // namespace revisit::core
