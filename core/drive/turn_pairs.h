// How common it is on the vehicle's own roads that one turn follows another:
// roads bend again and again, and grids repeat, so two neighbouring stretches
// are not independent of each other.
//
// A stretch of so many steps turns by the heading of its last node less that of
// its first; a pair is a stretch and the one that begins where it ends. Turns
// are counted in bins, and those of the neighbouring bins count as equal.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_TURN_PAIRS_H_
#define REVISIT_CORE_DRIVE_TURN_PAIRS_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/pose_graph.h"

namespace revisit::core {

inline constexpr int kTurnBins = 128;
// For a node without a whole stretch before it in its segment.
inline constexpr std::uint8_t kNoTurn = 255;

// The bin of a turn in [-pi, pi].
int TurnBin(double turn);

// The bins of the stretches that end at each node, a byte for each.
class TurnBins {
 public:
  // REQUIRES: stretch_nodes >= 1.
  explicit TurnBins(NodeIndex stretch_nodes) : stretch_nodes_(stretch_nodes) {}

  NodeIndex stretch_nodes() const { return stretch_nodes_; }
  // Adds the nodes that the graph has grown by.
  void Extend(const PoseGraph& graph);
  NodeIndex size() const { return static_cast<NodeIndex>(bins_.size()); }
  const std::vector<std::uint8_t>& bins() const { return bins_; }
  std::size_t bytes() const { return bins_.capacity(); }

  // The bins of nodes [first, end) as bytes. REQUIRES: end <= size().
  void SaveNodes(std::size_t first, std::size_t end, ByteWriter* writer) const;
  // Adds so many nodes that were saved; false if these are none.
  bool LoadNodes(std::size_t count, ByteReader* reader);

 private:
  NodeIndex stretch_nodes_;
  std::vector<std::uint8_t> bins_;
};

// The pairs whose later stretch ends at or before one node, of one graph or of
// several.
class TurnPairs {
 public:
  // There are none yet.
  TurnPairs();
  // O(last). REQUIRES: the bins have node `last`.
  TurnPairs(const TurnBins& bins, NodeIndex last);

  // Adds those of another graph, or takes them back out if `times` is -1.
  // REQUIRES: as for the constructor; stretches of as many nodes.
  void Add(const TurnBins& bins, NodeIndex last, std::int32_t times = 1);
  // Adds those of other graphs. REQUIRES: stretches of as many nodes.
  void Add(const TurnPairs& more);

  // The share of the stretches before one that turns by `later` which turn by
  // `turn`. `share` is that of all stretches which turn by `turn`, positive:
  // where pairs are too few to tell, it is the answer. As many stretches are
  // added as hold one that turns by `turn`, so that no share is 0.
  double Share(double turn, double later, double share) const;

 private:
  std::int64_t Count(int turn, int later) const {
    return counts_[static_cast<std::size_t>(later * kTurnBins + turn)];
  }

  // Pairs by the bins of the later stretch and of the one before it.
  std::vector<std::int32_t> counts_;
  // Pairs by the bin of the later stretch.
  std::vector<std::int64_t> later_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_TURN_PAIRS_H_
