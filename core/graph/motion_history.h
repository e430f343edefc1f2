// What motion_statistics.h measures over all of a vehicle's nodes, kept as the
// graph grows, so that a query does not walk them.
//
// By blocks of nodes: the sums of the steps' noise up to the end of each block,
// and the turns of the stretches in runs of blocks, each run sorted and as long
// as a power of two, the longest first (the logarithmic method; Bentley & Saxe,
// "Decomposable searching problems", J. Algorithms 1 (1980)). What lies between
// the end of a block and the node asked about is measured there and then, so
// that answers are those of the slow functions to the last bit, whatever has
// been taken on.
//
// At most 9.3 bytes a node; about 20 while the longest two runs are merged.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_GRAPH_MOTION_HISTORY_H_
#define REVISIT_CORE_GRAPH_MOTION_HISTORY_H_

#include <cstddef>
#include <variant>
#include <vector>

#include "core/geometry/pose.h"
#include "core/graph/correlation.h"
#include "core/graph/motion_statistics.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Of one graph, which all calls are given. Between them, nodes may be added to
// it and loop edges change; nothing else may.
class MotionHistory {
 public:
  // REQUIRES: stretch_nodes >= 1.
  MotionHistory(StateSpace space, CorrelationModel model,
                NodeIndex stretch_nodes);

  CorrelationModel model() const { return model_; }
  NodeIndex stretch_nodes() const { return stretch_nodes_; }

  // Takes on the nodes added since. Amortised O(log n) a node.
  void Extend(const PoseGraph& graph);

  // MeasureMotion() of these nodes. O(1), and as much for every node from the
  // last block taken on to `last`. REQUIRES: D is of the state space.
  template <int D>
  MotionStatistics<D> Measure(const PoseGraph& graph, NodeIndex last) const;

  // ShareOfStretches() of these nodes. O(turns log^2 n), and O(log(turns)) for
  // every node from the last block taken on to `last`, or from `last` to that
  // block; never more than ShareOfStretches() itself visits.
  std::vector<double> Shares(const PoseGraph& graph, NodeIndex last,
                             const std::vector<double>& turns,
                             double tolerance_radians) const;

  // Held on the heap.
  std::size_t bytes() const;

 private:
  static constexpr NodeIndex kBlockNodes = 128;

  // Of stretches whose last node lies after those of the run before, up to and
  // without `end`.
  struct Run {
    NodeIndex end = 0;
    std::vector<double> turns;
  };

  // Nodes of run k.
  NodeIndex Length(std::size_t k) const {
    return runs_[k].end - (k == 0 ? 0 : runs_[k - 1].end);
  }
  void MergeLastTwo();

  CorrelationModel model_;
  NodeIndex stretch_nodes_;
  // Entry k is over the first k + 1 blocks.
  template <int D>
  using Sums = std::vector<MotionSums<D>>;
  std::variant<Sums<3>, Sums<4>> sums_;
  std::vector<Run> runs_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_GRAPH_MOTION_HISTORY_H_
