// The statistics of motion_statistics.h over all nodes of a vehicle, kept up to
// date as the graph grows, so that a query need not walk all nodes.
//
// Kept per block of nodes: the sums of the steps' noise up to the end of each
// block, and the turns of stretches in runs of blocks. Each run is sorted, and
// its number of blocks is a power of two, the longest run first (the
// logarithmic method; Bentley & Saxe, "Decomposable searching problems", J.
// Algorithms 1 (1980)). Nodes between the end of a block and the node that a
// query asks about are measured during the query, so answers equal those of the
// slow functions to the last bit, whatever has been added so far.
//
// Takes at most 11.7 bytes per node, and about 22 while the two longest runs
// are merged.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_MOTION_HISTORY_H_
#define REVISIT_CORE_DRIVE_MOTION_HISTORY_H_

#include <cstddef>
#include <cstdint>
#include <variant>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/heading_bins.h"
#include "core/drive/motion_statistics.h"
#include "core/drive/pose_graph.h"
#include "core/drive/turn_pairs.h"
#include "core/geometry/pose.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

// Bound to one graph: pass the same graph to every call. Between calls, nodes
// may be added to it and loop edges may change; nothing else may.
class MotionHistory {
 public:
  // REQUIRES: stretch_nodes >= 1.
  MotionHistory(StateSpace space, const Correlation& correlation,
                NodeIndex stretch_nodes);

  const Correlation& correlation() const { return correlation_; }
  NodeIndex stretch_nodes() const { return turn_bins_.stretch_nodes(); }
  // The turns and headings of all nodes that were added.
  const TurnBins& turn_bins() const { return turn_bins_; }
  const HeadingBins& heading_bins() const { return heading_bins_; }

  // Adds the nodes that the graph has grown by. Amortised O(log n) per node.
  void Extend(const PoseGraph& graph);

  // Keeps what is not kept yet of the graph's last nodes, so that queries about
  // all of it measure none. Nothing can be added or saved any more.
  void Close(const PoseGraph& graph);

  // AddMotion() over nodes [0, last]. O(1 + nodes from the last added block to
  // `last`). REQUIRES: D is the dimension of the state space.
  template <int D>
  MotionSums<D> Sums(const PoseGraph& graph, NodeIndex last) const;

  // Lets the counter count the stretches within nodes [0, last], `times` times;
  // -1 takes them back out. O(turns log^2
  // n), and O(log(turns)) for each node between the last added block and
  // `last`; visits no more nodes than VisitStretches() itself.
  void Count(const PoseGraph& graph, NodeIndex last, StretchCounter* counter,
             std::int64_t times = 1) const;
  // Appends the turns of all stretches that are kept, in any order.
  void AppendTurns(std::vector<double>* turns) const;

  // Memory held on the heap.
  std::size_t bytes() const;

  // Writes what is kept of blocks [first, end) of the graph: the same bytes,
  // whatever was added since. REQUIRES: these blocks were added; end - first is
  // a power of two that divides `first`.
  void SaveBlocks(const PoseGraph& graph, std::size_t first, std::size_t end,
                  ByteWriter* writer) const;
  // Adds `count` blocks that were saved. False if these are not so many blocks:
  // then throw this away. Call EndLoading() before anything else. REQUIRES: all
  // before them have come by this call, in the same numbers.
  bool LoadBlocks(std::size_t count, ByteReader* reader);
  void EndLoading();

 private:
  static constexpr NodeIndex kBlockNodes = 128;

  // Sorted turns of the stretches whose last node lies in [end of the run
  // before, end).
  struct Run {
    NodeIndex end = 0;
    std::vector<double> turns;
  };

  // Number of nodes of run k.
  NodeIndex Length(std::size_t k) const {
    return runs_[k].end - (k == 0 ? 0 : runs_[k - 1].end);
  }
  void MergeLastTwo();
  // The sorted turns of the stretches that end at nodes [begin, end).
  Run Measure(const PoseGraph& graph, NodeIndex begin, NodeIndex end) const;

  Correlation correlation_;
  TurnBins turn_bins_;
  HeadingBins heading_bins_;
  // Entry k sums over the first k + 1 blocks.
  template <int D>
  using BlockSums = std::vector<MotionSums<D>>;
  std::variant<BlockSums<3>, BlockSums<4>> sums_;
  std::vector<Run> runs_;
  // Whether the last entry of all these is of all nodes, not of whole blocks.
  bool is_closed_ = false;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_MOTION_HISTORY_H_
