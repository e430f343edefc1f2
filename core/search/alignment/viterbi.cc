#include "core/search/alignment/viterbi.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>

#include "core/noise/similarity_model.h"
#include "core/search/alignment/similarity_kernel.h"
#include "core/search/alignment/trellis_kernel.h"

namespace revisit::core {
namespace {

constexpr NodeIndex kNowhere = -1;
constexpr std::size_t kBlock = NodeBlock::kSize;

// Calls visit(first, emission) for the history block by block. `emission` holds
// a whole block; its entries beyond the history are undefined.
template <typename Visit>
void VisitEmissions(const PoseGraph& graph, const SimilarityModel& model,
                    NodeIndex query, NodeIndex size, const Visit& visit) {
  if (model.correlation.noise().has_closed_form()) {
    VisitBlockSimilarities(graph, model, query, size,
                           [&](NodeIndex first, const BlockSimilarity& part) {
                             visit(first, part.log_similarity.data());
                           });
    return;
  }
  std::vector<double> column;
  LogSimilarityColumn(graph, model, query, size, &column);
  column.resize(BlocksOf(size) * kBlock);
  for (std::size_t first = 0; first < column.size(); first += kBlock) {
    visit(static_cast<NodeIndex>(first), column.data() + first);
  }
}

}  // namespace

void Alignment::FindJunctions(const PoseGraph& graph, NodeIndex size) {
  std::vector<NodeIndex> nodes;
  for (NodeIndex start = 0; start < size; start = graph.SegmentEnd(start)) {
    nodes.push_back(start);
    nodes.push_back(std::min(graph.SegmentEnd(start), size) - 1);
  }
  for (const auto& [a, b] : graph.LoopEdges()) {
    if (a >= size || b >= size) continue;
    nodes.push_back(a);
    nodes.push_back(b);
  }
  std::sort(nodes.begin(), nodes.end());
  nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
  for (const NodeIndex node : nodes) {
    Junction junction;
    junction.node = node;
    std::vector<NodeIndex>& neighbours = junction.neighbours;
    if (graph.SegmentStart(node) != node) neighbours.push_back(node - 1);
    if (node + 1 < std::min(graph.SegmentEnd(node), size)) {
      neighbours.push_back(node + 1);
    }
    for (const NodeIndex other : graph.LoopNeighbours(node)) {
      if (other < size) neighbours.push_back(other);
    }
    if (!neighbours.empty()) {
      junction.log_degree = std::log(static_cast<double>(neighbours.size()));
    }
    junctions_.push_back(std::move(junction));
  }
}

NodeIndex Alignment::Before(std::int64_t t, NodeIndex node) const {
  const auto found = std::lower_bound(
      junctions_.begin(), junctions_.end(), node,
      [](const Junction& junction, NodeIndex i) { return junction.node < i; });
  const auto row = static_cast<std::size_t>(t - 1);
  if (found != junctions_.end() && found->node == node) {
    return from_junction_[row * junctions_.size() +
                          static_cast<std::size_t>(found - junctions_.begin())];
  }
  const auto at = static_cast<std::size_t>(node);
  const std::uint8_t byte =
      from_after_[row * BlocksOf(size()) * kStepBytes + at / 8];
  return (byte >> (at % 8) & 1) != 0 ? node + 1 : node - 1;
}

std::vector<NodeIndex> Alignment::Path(NodeIndex j) const {
  assert(score(j) != kImpossible);
  std::vector<NodeIndex> path(static_cast<std::size_t>(steps_));
  NodeIndex node = j;
  for (std::int64_t t = steps_ - 1; t >= 0; --t) {
    path[static_cast<std::size_t>(t)] = node;
    if (t > 0) node = Before(t, node);
  }
  return path;
}

std::optional<Alignment> Align(const PoseGraph& graph,
                               const SimilarityModel& model, NodeIndex query,
                               std::int64_t steps, NodeIndex history_size,
                               const ShouldStop& should_stop) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query - steps + 1);
  Alignment alignment;
  alignment.steps_ = steps;
  alignment.FindJunctions(graph, history_size);
  const std::size_t blocks = BlocksOf(history_size);
  const auto past_first = static_cast<std::size_t>(steps - 1);
  alignment.from_after_.resize(past_first * blocks * kStepBytes);
  alignment.from_junction_.resize(past_first * alignment.junctions_.size());

  // Score of the best path to each node, less the cost of leaving it, with room
  // for a neighbour at either end.
  std::vector<double> leaving(blocks * kBlock + 2);
  std::vector<double> next(leaving.size());
  for (std::int64_t t = 0; t < steps; ++t) {
    if (t > 0 && should_stop && should_stop()) return std::nullopt;
    std::size_t junction = 0;
    VisitEmissions(graph, model, query - steps + 1 + t, history_size,
                   [&](NodeIndex first, const double* emission) {
                     alignment.StepBlockAt(t, first, emission, leaving, &next);
                     alignment.StepJunctionsOf(t, first, emission, leaving,
                                               &junction, &next);
                   });
    std::swap(leaving, next);
  }
  alignment.scores_.assign(leaving.begin() + 1,
                           leaving.begin() + 1 + history_size);
  return alignment;
}

// Takes step t to the nodes of the block that begins at node `first`, as if
// each had the nodes before and after it for neighbours.
void Alignment::StepBlockAt(std::int64_t t, NodeIndex first,
                            const double* emission,
                            const std::vector<double>& leaving,
                            std::vector<double>* next) {
  const auto at = static_cast<std::size_t>(first);
  // The last node of a path is not left.
  const double cost = t + 1 == steps_ ? 0.0 : std::log(2.0);
  double* const to = next->data() + 1 + at;
  if (t == 0) {
    for (std::size_t k = 0; k < kBlock; ++k) to[k] = emission[k] - cost;
    return;
  }
  const std::size_t blocks = (leaving.size() - 2) / kBlock;
  const std::size_t row = static_cast<std::size_t>(t - 1) * blocks * kStepBytes;
  StepBlock(leaving.data() + 1 + at, emission, cost, to,
            from_after_.data() + row + at / 8);
}

// Takes step t to the junctions of that block, from `junction` on, and leaves
// that at the first behind it.
void Alignment::StepJunctionsOf(std::int64_t t, NodeIndex first,
                                const double* emission,
                                const std::vector<double>& leaving,
                                std::size_t* junction,
                                std::vector<double>* next) {
  const NodeIndex end = first + static_cast<NodeIndex>(kBlock);
  for (; *junction < junctions_.size() && junctions_[*junction].node < end;
       ++*junction) {
    const Junction& here = junctions_[*junction];
    double best = t == 0 ? 0.0 : kImpossible;
    if (t > 0) {
      NodeIndex from = kNowhere;
      for (const NodeIndex i : here.neighbours) {
        const double over = leaving[1 + static_cast<std::size_t>(i)];
        if (over > best) {
          best = over;
          from = i;
        }
      }
      from_junction_[static_cast<std::size_t>(t - 1) * junctions_.size() +
                     *junction] = from;
    }
    const double cost = t + 1 == steps_ ? 0.0 : here.log_degree;
    (*next)[1 + static_cast<std::size_t>(here.node)] =
        best + emission[here.node - first] - cost;
  }
}

}  // namespace revisit::core
