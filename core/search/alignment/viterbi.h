// Aligns the recent path with the history: the paper's Eq. 4-6 and Algorithm 1,
// in log space, with its two slips in print corrected (the emission of state i
// at step j is lambda(i,j), and there are as many hidden states as history
// nodes).
//
// p are the k nodes that end at the query. q is a path of k nodes in the
// history, with each step along an edge: between consecutive nodes, either way,
// or over a loop closure. The hidden states are the history's nodes. The
// transition out of h is uniform over its edges within the history:
// -ln(degree of h). For every node j, the best q that ends at j is sought:
//
//   score(j) = max over q of sum_t lambda(p_t, q_t) - sum_t ln degree(q_t)
//
// with the second sum over all but the last node of q.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_VITERBI_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_VITERBI_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/should_stop.h"

namespace revisit::core {

// The solved trellis of one query.
class Alignment {
 public:
  // The history is nodes [0, size()).
  NodeIndex size() const { return static_cast<NodeIndex>(scores_.size()); }

  // Best score of a path that ends at history node j; kImpossible if none does.
  double score(NodeIndex j) const {
    return scores_[static_cast<std::size_t>(j)];
  }

  const std::vector<double>& scores() const { return scores_; }

  // The history nodes of that path, oldest first, one for each node of p. Of
  // paths with equal scores, the one that, going back from the end, comes from
  // the node before, else from the node after, else over the loop closure that
  // was added first. REQUIRES: score(j) is not kImpossible.
  std::vector<NodeIndex> Path(NodeIndex j) const;

 private:
  friend std::optional<Alignment> Align(const PoseGraph&,
                                        const SimilarityModel&, NodeIndex,
                                        std::int64_t, NodeIndex,
                                        const ShouldStop&);

  // A node of the history with other edges than those to the node before and
  // the node after: it has loop closures, or a segment or the history begins or
  // ends there.
  struct Junction {
    NodeIndex node = 0;
    // Logarithm of the number of its edges.
    double log_degree = 0.0;
    // Other ends of its edges: the node before, the node after, then loop
    // closures as they were added.
    std::vector<NodeIndex> neighbours;
  };

  void FindJunctions(const PoseGraph& graph, NodeIndex size);
  void StepBlockAt(std::int64_t t, NodeIndex first, const double* emission,
                   const std::vector<double>& leaving,
                   std::vector<double>* next);
  void StepJunctionsOf(std::int64_t t, NodeIndex first, const double* emission,
                       const std::vector<double>& leaving,
                       std::size_t* junction, std::vector<double>* next);
  NodeIndex Before(std::int64_t t, NodeIndex node) const;

  std::vector<double> scores_;
  std::int64_t steps_ = 0;
  // Sorted by node.
  std::vector<Junction> junctions_;
  // A bit for each step t in [1, k) and node, kStepBytes per block: whether its
  // predecessor on the best path is the node after it (else the node before
  // it). Undefined for junctions.
  std::vector<std::uint8_t> from_after_;
  // For step t, at (t - 1) * junctions + junction: its predecessor on the best
  // path.
  std::vector<NodeIndex> from_junction_;
};

// Aligns the `steps` nodes that end at `query` with the history [0,
// history_size). Time and memory O(steps * (history_size + loop edges)), with a
// bit per step and node. Returns nothing if told to stop. REQUIRES: 1 <= steps
// <= query + 1, history_size <= query - steps + 1.
std::optional<Alignment> Align(const PoseGraph& graph,
                               const SimilarityModel& model, NodeIndex query,
                               std::int64_t steps, NodeIndex history_size,
                               const ShouldStop& should_stop);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_VITERBI_H_
