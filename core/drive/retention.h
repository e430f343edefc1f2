// Which nodes of a vehicle's history are no longer wanted: those that are too
// old, and those of places that were passed often enough.
//
// A node is covered if so many better passes of its place, in its direction,
// stay as are to be kept. A pass is better if its position is known twice as
// well, or, where both are known about alike, if it is the later one. Two nodes
// are surely of one place if
//
//   |d|^2 + tr G <= r^2   and   |d|^2 <= 4 t^2 + (s / 2)^2 + tr G,
//
// with d the difference of their positions, G its covariance by the vehicle's
// correlation model, t the place tolerance, s the distance between two nodes
// that are compared, and r^2 = kPassRadiusMeters^2 + (s / 2)^2: the true
// positions lie within r of each other in the root mean square, and no farther
// than the tolerance and the errors explain; and their headings are surely
// alike, in the same sense. Where the path was reckoned, G grows with the way,
// so that places are sure again only once an optimiser has revised the poses.
//
// What is too old, stamps.h says.
//
// Passes are counted within a recording, since only there all is in one frame.
// The first and the last node of each recording stay: by them its frame is tied
// to others.
//
// A search finds a node by the path that leads to it, so what has to stay,
// stays together with as many nodes before it as a search aligns.
#ifndef REVISIT_CORE_DRIVE_RETENTION_H_
#define REVISIT_CORE_DRIVE_RETENTION_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/node_index.h"
#include "core/drive/node_range.h"
#include "core/geometry/pose.h"
#include "core/noise/noise_model.h"
#include "core/settings.h"

namespace revisit::core {

class PoseGraph;

// Passes of one place lie so far apart at most.
inline constexpr double kPassRadiusMeters = 10.0;

// The needs of searches, by which nodes stay.
struct RetentionNeeds {
  StateSpace state_space = StateSpace::kPlanar;
  Correlation correlation;
  // t, and the distance between two nodes.
  double tolerance_meters = 2.0;
  double spacing_meters = 2.0;
  // Two nodes nearer to each other along the path than this, or than 4 r, are
  // of one pass.
  double separation_meters = 10.0;
  // Nodes that a search aligns with the history.
  NodeIndex aligned_nodes = 150;
  // The last nodes, which all stay.
  NodeIndex newest_nodes = 1000;
  // Votes that have to agree on a stamp (stamps.h).
  NodeIndex agreeing_nodes = 75;
  // Covered nodes are dropped where there are at least so many in a row.
  NodeIndex least_nodes = 150;
  // Nodes to which confirmed loop closures refer. Each stays, with as many
  // nodes before it as a search aligns, and those within kPassRadiusMeters
  // behind it.
  std::vector<NodeIndex> loop_ends;
  // The first nodes of recordings, in order; none where there is one that
  // nobody told of.
  std::vector<NodeIndex> recording_starts;
};

// Whether all but the nodes that stay are equal.
bool HaveSameRules(const RetentionNeeds& a, const RetentionNeeds& b);

// Looks for the nodes of a graph that are to be dropped, a part at a time: for
// a million nodes it takes some seconds, and up to a minute where all lie in
// one place and are hardly sure.
//
// It is about the nodes that the graph has when it begins. Nodes that are added
// meanwhile change nothing, and nothing else about the graph may change.
class DroppableSearch {
 public:
  // The graph outlives it. `latest_ns`: stamps that are later by the caller's
  // clock have no vote. REQUIRES: max_passes in [0, kMostPasses].
  DroppableSearch(const PoseGraph& graph, const RetentionOptions& options,
                  RetentionNeeds needs, std::optional<std::int64_t> latest_ns);
  ~DroppableSearch();

  DroppableSearch(const DroppableSearch&) = delete;
  DroppableSearch& operator=(const DroppableSearch&) = delete;

  const RetentionOptions& options() const;
  const RetentionNeeds& needs() const;

  // Does what is next for so many nodes, which takes below 0.1 ms for each.
  // Returns whether all is done.
  bool Advance(NodeIndex nodes);

  // Returns the nodes to drop, but for those that stay for these ends of loops,
  // which may have come since it began: ranges in ascending order that do not
  // touch each other, none of them empty. O(n), some nanoseconds for each.
  // REQUIRES: all is done.
  std::vector<NodeRange> Droppable(const std::vector<NodeIndex>& loop_ends);
  // How many nodes of these ranges are too old; the others are covered.
  // REQUIRES: ranges that Droppable() returned.
  NodeIndex CountTooOld(const std::vector<NodeRange>& ranges) const;

 private:
  class Impl;
  const std::unique_ptr<Impl> impl_;
};

// The first and the last sequence number of the poses from which no node
// outside of a range comes; there are none if last < first. REQUIRES: a range
// of the graph, not empty, that does not reach its end.
struct SequenceRange {
  std::uint64_t first = 0;
  std::uint64_t last = 0;
};
SequenceRange SequencesOf(const PoseGraph& graph, const NodeRange& nodes);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_RETENTION_H_
