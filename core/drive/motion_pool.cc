#include "core/drive/motion_pool.h"

#include <algorithm>
#include <cassert>

#include "core/drive/motion_history.h"

namespace revisit::core {

MotionPool::MotionPool(const std::vector<const DriveView*>& views)
    : stretch_nodes_(views.front()->motion_history.stretch_nodes()) {
  for (const DriveView* view : views) {
    const MotionHistory& motion = view->motion_history;
    assert(motion.stretch_nodes() == stretch_nodes_);
    motion.AppendTurns(&turns_);
    if (view->graph.size() > 0) {
      pairs_.Add(motion.turn_bins(), view->graph.size() - 1);
    }
  }
  turns_.shrink_to_fit();
  std::sort(turns_.begin(), turns_.end());
}

}  // namespace revisit::core
