// The turns of several drives in one heap, so that a search which asks how
// common they are looks once, and not drive by drive. What it tells are counts,
// so that it equals what the drives tell one by one.
#ifndef REVISIT_CORE_DRIVE_MOTION_POOL_H_
#define REVISIT_CORE_DRIVE_MOTION_POOL_H_

#include <cstddef>
#include <vector>

#include "core/drive/drive_view.h"
#include "core/drive/node_index.h"
#include "core/drive/turn_pairs.h"

namespace revisit::core {

// Immutable.
class MotionPool {
 public:
  // Pools the motion of all nodes of the views. O(nodes log(nodes)). REQUIRES:
  // there is a view, and all have stretches of as many nodes.
  explicit MotionPool(const std::vector<const DriveView*>& views);

  NodeIndex stretch_nodes() const { return stretch_nodes_; }
  // The turns of all stretches, sorted.
  const std::vector<double>& turns() const { return turns_; }
  const TurnPairs& pairs() const { return pairs_; }

 private:
  NodeIndex stretch_nodes_;
  std::vector<double> turns_;
  TurnPairs pairs_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_MOTION_POOL_H_
