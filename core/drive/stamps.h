// What the stamps of a vehicle's nodes say together, although some of them may
// be wrong: by them it is judged what is too old (retention.h).
//
// A stamp counts as a vote if it is the first among the nodes that lie between
// the same two poses, so that one wrong pose, of which many nodes may have
// their stamps, has two votes at most; and if it is not later than the caller's
// clock allows. With k votes in agreement:
//
//   agreed(c)  the median of the last 2 k - 1 votes among the first c nodes;
//              none if there are fewer. So k votes are not earlier and k are
//              not later: fewer than k wrong ones, in whichever direction, move
//              it no farther than to another of the right ones.
//   newest     agreed(n) for a graph of n nodes, unless it is later than
//              agreed(n - l) by more than a tenth of the greatest age, with l
//              the newest nodes, which stay in any case. Then stamps have
//              leapt, or the vehicle has stood for long, and newest is
//              agreed(n - l) until l nodes and k votes have lasted behind that.
//              None if one of the two is none.
//   oldest     newest less the greatest age.
//   old begin  the nodes before the first one at which k of the last 2 k - 1
//              votes are oldest or later. Poses come in the order in which they
//              were taken, so whatever lies behind is not too old, whatever its
//              stamp.
//
// A node is too old if it lies in the old begin and its own stamp is earlier
// than oldest.
#ifndef REVISIT_CORE_DRIVE_STAMPS_H_
#define REVISIT_CORE_DRIVE_STAMPS_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/findings.h"
#include "core/drive/node_index.h"

namespace revisit::core {

class PoseGraph;

struct AgeRules {
  std::int64_t max_age_ns = 0;
  // k, and l.
  NodeIndex agreeing_nodes = 75;
  NodeIndex newest_nodes = 1000;
  // Later stamps have no vote. The core has no clock: whoever has one says.
  std::optional<std::int64_t> latest_ns;
};

// agreed(count), and oldest of the whole graph, which the top of this file
// defines; nothing where there is none. O(votes), and O(nodes) where few have a
// stamp. REQUIRES: agreeing_nodes > 0; 0 <= count <= size of the graph.
std::optional<std::int64_t> AgreedStamp(const PoseGraph& graph, NodeIndex count,
                                        const AgeRules& rules);
std::optional<std::int64_t> OldestStamp(const PoseGraph& graph,
                                        const AgeRules& rules);

// Goes through a graph from its first node on and tells which nodes are too
// old. O(1) per node.
class OldNodes {
 public:
  // The graph outlives it.
  OldNodes(const PoseGraph& graph, const AgeRules& rules);

  // Whether the node is too old. REQUIRES: called for each node in order.
  bool IsTooOld(NodeIndex i);

 private:
  const PoseGraph& graph_;
  const AgeRules rules_;
  const std::optional<std::int64_t> oldest_ns_;
  // Whether the last votes, as many as fit, are young; the next one replaces
  // that at `votes_` modulo their number.
  std::vector<bool> young_;
  std::size_t votes_ = 0;
  NodeIndex young_count_ = 0;
  bool in_old_begin_ = true;
};

// Watches for leaps of the stamps (StampLeap) as a graph grows. A leap is the
// step from the last stamp before a node's own two poses, at most kReach nodes
// and l before it, to the node's stamp, so it is seen at once and no vote is
// needed. None leads over poses that were dropped. O(1) per node.
class LeapWatch {
 public:
  // No leap is seen without a greatest age.
  LeapWatch(std::optional<std::int64_t> max_age_ns, NodeIndex newest_nodes);

  // Looks at the nodes by which the graph has grown. What is seen depends on
  // these arguments alone. REQUIRES: the same two at each call.
  void Extend(const PoseGraph& graph, const DroppedStretches& dropped);

  // The last leap, while it lies among the newest nodes.
  std::optional<StampLeap> leap() const;

 private:
  // All nodes between two poses, and some.
  static constexpr NodeIndex kReach = 1001;

  struct Stamp {
    NodeIndex node = 0;
    std::int64_t ns = 0;
  };

  struct Leap {
    NodeIndex node = 0;
    StampLeap leap;
  };

  std::optional<std::int64_t> max_age_ns_;
  NodeIndex newest_nodes_;
  NodeIndex next_ = 0;
  // Stretches that were dropped before the next node, at least.
  std::size_t gaps_ = 0;
  // The poses between which the last node lies begin with this one.
  std::uint64_t sequence_ = 0;
  // The last stamp before these poses, and the last of all.
  std::optional<Stamp> before_;
  std::optional<Stamp> last_;
  // Every vehicle in memory has a watch, so it holds room for a leap only where
  // one was seen.
  std::unique_ptr<const Leap> leap_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_STAMPS_H_
