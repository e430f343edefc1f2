// A drive as it was at one moment, as far as searches of other drives need it.
//
// A view is made once and never changes, so that any number of threads may read
// it while the drive goes on. It shares the full blocks of the graph with the
// drive and has all else of its own (Drive::View()).
#ifndef REVISIT_CORE_DRIVE_DRIVE_VIEW_H_
#define REVISIT_CORE_DRIVE_DRIVE_VIEW_H_

#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/frame_relation.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_extent.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/state_space.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

struct DriveView {
  StateSpace state_space = StateSpace::kPlanar;
  double node_spacing_meters = 0.0;
  Correlation correlation;
  // The true standard deviations to those of the graph, as far as the drive has
  // shown them.
  double scale = 1.0;
  PoseGraph graph;
  // Indexes of the graph.
  MotionHistory motion_history;
  BlockBounds block_bounds;
  Recordings recordings;
  // The confirmed loops, in the order in which they came.
  std::vector<ConfirmedLoop> loops;
  // The poses that the graph lacks.
  DroppedStretches dropped;
  // Where its nodes lie, by recording.
  std::vector<std::vector<NodeExtent>> extents;

  // The view must outlive them.
  FrameNodes nodes() const { return {graph, state_space, correlation, scale}; }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_DRIVE_VIEW_H_
