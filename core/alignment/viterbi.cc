#include "core/alignment/viterbi.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>

namespace revisit::core {
namespace {

constexpr std::uint32_t kNowhere = 0xffffffff;

// The part of the graph that paths of history may walk: nodes [0, size).
struct History {
  // Whether node i has an edge to node i - 1.
  std::vector<char> joined;
  // Both directions of every loop-closure edge, (to, from), ordered by `to` and
  // then as added.
  std::vector<std::pair<NodeIndex, NodeIndex>> loops;
  // ln of the number of edges at each node.
  std::vector<double> log_degree;
};

History MakeHistory(const PoseGraph& graph, NodeIndex size) {
  History history;
  const auto count = static_cast<std::size_t>(size);
  history.joined.resize(count);
  history.log_degree.resize(count);
  for (NodeIndex i = 0; i < size; ++i) {
    history.joined[static_cast<std::size_t>(i)] = graph.SegmentStart(i) != i;
  }
  for (NodeIndex i = 0; i < size; ++i) {
    const auto position = static_cast<std::size_t>(i);
    int degree = history.joined[position];
    if (i + 1 < size) degree += history.joined[position + 1];
    for (NodeIndex other : graph.LoopNeighbours(i)) {
      if (other >= size) continue;
      history.loops.emplace_back(i, other);
      ++degree;
    }
    history.log_degree[position] = degree > 0 ? std::log(degree) : 0.0;
  }
  return history;
}

}  // namespace

std::vector<NodeIndex> Alignment::Path(NodeIndex j) const {
  assert(score(j) != kImpossible);
  std::vector<NodeIndex> path(static_cast<std::size_t>(steps_));
  NodeIndex node = j;
  for (std::int64_t t = steps_ - 1; t >= 0; --t) {
    path[static_cast<std::size_t>(t)] = node;
    if (t > 0) {
      node = came_from_[static_cast<std::size_t>((t - 1) * size() + node)];
    }
  }
  return path;
}

std::optional<Alignment> Align(const PoseGraph& graph,
                               const SimilarityModel& model, NodeIndex query,
                               std::int64_t steps, NodeIndex history_size,
                               const ShouldStop& should_stop) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query - steps + 1);
  const auto size = static_cast<std::size_t>(history_size);
  const History history = MakeHistory(graph, history_size);

  Alignment alignment;
  alignment.steps_ = steps;
  alignment.came_from_.resize(static_cast<std::size_t>(steps - 1) * size);
  std::vector<double>& scores = alignment.scores_;
  std::vector<double> emission;
  // Score of the best path to each node, less the cost of leaving it.
  std::vector<double> leaving(size);

  LogSimilarityColumn(graph, model, query - steps + 1, history_size, &scores);
  for (std::int64_t t = 1; t < steps; ++t) {
    if (should_stop && should_stop()) return std::nullopt;
    for (std::size_t i = 0; i < size; ++i) {
      leaving[i] = scores[i] - history.log_degree[i];
    }
    LogSimilarityColumn(graph, model, query - steps + 1 + t, history_size,
                        &emission);
    std::uint32_t* const came_from =
        alignment.came_from_.data() + static_cast<std::size_t>(t - 1) * size;
    for (std::size_t i = 0; i < size; ++i) {
      double best = kImpossible;
      std::uint32_t from = kNowhere;
      if (history.joined[i]) {
        best = leaving[i - 1];
        from = static_cast<std::uint32_t>(i - 1);
      }
      if (i + 1 < size && history.joined[i + 1] && leaving[i + 1] > best) {
        best = leaving[i + 1];
        from = static_cast<std::uint32_t>(i + 1);
      }
      scores[i] = best;
      came_from[i] = from;
    }
    for (const auto& [to, from] : history.loops) {
      const auto position = static_cast<std::size_t>(to);
      const double over_loop = leaving[static_cast<std::size_t>(from)];
      if (over_loop > scores[position]) {
        scores[position] = over_loop;
        came_from[position] = static_cast<std::uint32_t>(from);
      }
    }
    for (std::size_t i = 0; i < size; ++i) scores[i] += emission[i];
  }
  return alignment;
}

}  // namespace revisit::core
