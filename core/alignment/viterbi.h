// Aligns the recent path with the history: the paper's Eq. 4-6 and Algorithm 1,
// in log space, with its two slips in print corrected (the emission of state i
// at step j is lambda(i,j), and there are as many hidden states as history
// nodes).
//
// p = the k nodes that end at the query. q = a path of k nodes in the history,
// each step along an edge: consecutive nodes either way, or a loop closure. The
// hidden states are the history's nodes; the transition out of h is uniform
// over its edges within the history, -ln(degree of h). Sought, for every node
// j, is the best q that ends at j:
//
//   score(j) = max over q ending at j of sum_t lambda(p_t, q_t) - sum_t ln
//   deg(q_t)
//
// with the second sum over all but the last node of q.
#ifndef REVISIT_CORE_ALIGNMENT_VITERBI_H_
#define REVISIT_CORE_ALIGNMENT_VITERBI_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "core/alignment/log_similarity.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Asked now and then during long work; true means give up.
using ShouldStop = std::function<bool()>;

// The solved trellis of one query.
class Alignment {
 public:
  // Nodes of history: [0, size).
  NodeIndex size() const { return static_cast<NodeIndex>(scores_.size()); }

  // Best score of a path that ends at history node j; kImpossible if none does.
  double score(NodeIndex j) const {
    return scores_[static_cast<std::size_t>(j)];
  }

  const std::vector<double>& scores() const { return scores_; }

  // The history nodes of that path, oldest first, one for each of p. Among
  // equal paths, back from the end: from the node before, else from the node
  // after, else over the loop closure that was added first. REQUIRES: score(j)
  // is not kImpossible.
  std::vector<NodeIndex> Path(NodeIndex j) const;

 private:
  friend std::optional<Alignment> Align(const PoseGraph&,
                                        const SimilarityModel&, NodeIndex,
                                        std::int64_t, NodeIndex,
                                        const ShouldStop&);

  // A node of history that is not just between two others: it has loop
  // closures, or lies where a segment or the history begins or ends.
  struct Junction {
    NodeIndex node = 0;
    // ln of the number of its edges.
    double log_degree = 0.0;
    // By edges, before, after, then loop closures as added.
    std::vector<NodeIndex> neighbours;
  };

  void FindJunctions(const PoseGraph& graph, NodeIndex size);
  NodeIndex Before(std::int64_t t, NodeIndex node) const;

  std::vector<double> scores_;
  std::int64_t steps_ = 0;
  // In the order of nodes.
  std::vector<Junction> junctions_;
  // For step t in [1, k), at (t - 1) * row + node: whether the node before it
  // on the best path is the one after it on the road. Not of junctions.
  std::vector<std::uint8_t> from_after_;
  // For step t, at (t - 1) * junctions + junction: the node before it.
  std::vector<NodeIndex> from_junction_;
};

// Aligns the `steps` nodes that end at `query` with the history [0,
// history_size). Time and memory O(steps * (history_size + loop edges)): a bit
// a step and node. Nothing if told to stop. REQUIRES: 1 <= steps <= query + 1,
// history_size <= query - steps + 1.
std::optional<Alignment> Align(const PoseGraph& graph,
                               const SimilarityModel& model, NodeIndex query,
                               std::int64_t steps, NodeIndex history_size,
                               const ShouldStop& should_stop);

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_VITERBI_H_
