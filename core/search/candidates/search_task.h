// The inputs of one search for candidates.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "core/drive/block_bounds.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/scored_ends.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/should_stop.h"
#include "core/settings.h"

namespace revisit::core {

struct SearchTask {
  SearchTask(const PoseGraph& of_graph, const MotionHistory& of_motion,
             const BlockBounds& of_blocks, const SearchOptions& with_options,
             const ShouldStop& stop)
      : graph(of_graph),
        motion_history(of_motion),
        block_bounds(of_blocks),
        options(with_options),
        should_stop(stop) {}

  const PoseGraph& graph;
  // Indexes of the graph.
  const MotionHistory& motion_history;
  const BlockBounds& block_bounds;

  const SearchOptions& options;
  double node_spacing_meters = 0.0;
  // The model that the options ask for, inflated. Its direction is ignored.
  SimilarityModel similarity;

  // The `steps` nodes that end at `query` are sought in the history [0,
  // history_size), but not as ends in `not_sought`. The history may hold the
  // first of these nodes too.
  NodeIndex query = 0;
  std::int64_t steps = 0;
  NodeIndex history_size = 0;
  std::vector<NodeRange> not_sought;
  // The last loop closure whose nodes both lie at or before the query.
  std::optional<ConfirmedLoop> last_confirmed;
  // What the drive has shown before the query; nothing where that is not used.
  std::optional<DriveBelief> belief;

  const ShouldStop& should_stop;
  // The parts of an alignment of the same nodes with the same options, or null.
  AlignmentParts* parts = nullptr;
};

// The directions that a search looks in: the same direction first.
std::vector<Direction> Directions(SearchDirection direction);

// The status of a search that was told to stop.
absl::Status StoppedError();

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_
