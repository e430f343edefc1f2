#include "core/drive/block_growth.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cstddef>

#include "core/geometry/positive_definite.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"

namespace revisit::core {
namespace {

template <int D>
bool NoiseIsAdded(const PoseGraph& graph, NodeIndex earlier, NodeIndex later) {
  const StateMatrix<D> added = ToMatrix<D>(graph.covariance(later)) -
                               Swung<D>(ToMatrix<D>(graph.covariance(earlier)),
                                        graph.pose(earlier), graph.pose(later));
  if (IsClearlyPositiveDefinite<D>(added)) return true;
  const Eigen::LDLT<StateMatrix<D>> ldlt(added);
  return ldlt.info() == Eigen::Success && ldlt.isPositive() &&
         ldlt.vectorD().minCoeff() > 0.0;
}

}  // namespace

bool NoiseIsAdded(StateSpace space, const PoseGraph& graph, NodeIndex earlier,
                  NodeIndex later) {
  return space == StateSpace::kPlanar ? NoiseIsAdded<3>(graph, earlier, later)
                                      : NoiseIsAdded<4>(graph, earlier, later);
}

namespace {

bool GrowsAt(StateSpace space, const PoseGraph& graph, NodeIndex node,
             NodeIndex reference) {
  return NoiseIsAdded(space, graph, std::min(node, reference),
                      std::max(node, reference));
}

}  // namespace

std::vector<char> BlocksGrowing(StateSpace space, const PoseGraph& graph,
                                const NodeRange& nodes, NodeIndex reference) {
  constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
  std::vector<char> growing(static_cast<std::size_t>(nodes.last / kBlock));
  for (std::size_t k = 0; k < growing.size(); ++k) {
    const auto first = static_cast<NodeIndex>(k) * kBlock;
    bool grows = first >= nodes.first;
    for (NodeIndex j = first; grows && j < first + kBlock; ++j) {
      grows = GrowsAt(space, graph, j, reference);
    }
    growing[k] = grows ? 1 : 0;
  }
  return growing;
}

bool AllGrow(StateSpace space, const PoseGraph& graph, const NodeRange& nodes,
             NodeIndex reference, const std::vector<char>& growing) {
  constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
  for (NodeIndex j = nodes.first; j < nodes.last; ++j) {
    const auto block = static_cast<std::size_t>(j / kBlock);
    if (block < growing.size() && growing[block]) {
      j = (j / kBlock + 1) * kBlock - 1;
    } else if (j != reference && !GrowsAt(space, graph, j, reference)) {
      return false;
    }
  }
  return true;
}

Growth GrowthFrom(StateSpace space, const PoseGraph& graph,
                  const NodeRange& nodes, NodeIndex reference) {
  Growth growth;
  growth.blocks = BlocksGrowing(space, graph, nodes, reference);
  growth.all_grow = AllGrow(space, graph, nodes, reference, growth.blocks);
  return growth;
}

}  // namespace revisit::core
