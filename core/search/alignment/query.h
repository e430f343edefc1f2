// A search asks whether the vehicle, at the end of this path, is where it
// has been before, and where that is.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_QUERY_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_QUERY_H_

#include <cstdint>
#include <vector>

#include "core/drive/motion_history.h"
#include "core/drive/motion_pool.h"
#include "core/drive/pose_graph.h"

namespace revisit::core {

// The nodes [0, last] of a graph, and its index or null. Both outlive this.
struct DrivenMotion {
  const PoseGraph& graph;
  const MotionHistory* history = nullptr;
  NodeIndex last = 0;
};

// The motion of other drives.
struct MotionOfOthers {
  // The motion of each drive.
  std::vector<DrivenMotion> drives;
  // The turns of the same drives: those of pools, but for some of each, and of
  // the drives that are in none.
  struct Pooled {
    // Outlives this.
    const MotionPool& pool;
    std::vector<DrivenMotion> without;
  };
  std::vector<Pooled> pooled;
  std::vector<DrivenMotion> alone;
};

// All that an answer tells of poses and errors is in the frame of the asking
// drive.
struct Query {
  // The drive that asks; outlives the query.
  const PoseGraph& graph;
  // The node at which it asks. Nodes behind it have no part in the answer.
  NodeIndex node = 0;
  // The recent path: the `steps` nodes that end at the node. REQUIRES: they lie
  // in one segment.
  std::int64_t steps = 1;
  // The index of the graph, or null. It saves measuring the graph's motion
  // anew.
  const MotionHistory* motion_history = nullptr;
  // The motion of other drives that are searched too: what their roads and
  // estimators are like counts as that of the graph up to the node does.
  const MotionOfOthers* others = nullptr;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_QUERY_H_
