// The inputs of one search for candidates.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "core/drive/block_bounds.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relations.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/should_stop.h"
#include "core/settings.h"

namespace revisit::core {

// The knowledge with which a search begins.
struct SearchPrior {
  // The model that the options ask for, inflated. Its direction is ignored.
  SimilarityModel similarity;
  // The last loop closure whose nodes both lie at or before the query.
  std::optional<ConfirmedLoop> last_confirmed;
  // What the drive has shown before the query; nothing where that is not used.
  std::optional<DriveBelief> belief;
};

struct SearchTask {
  // Nodes in all histories.
  NodeIndex history_size() const;

  // The query's path is sought in all of the histories, which may hold the
  // first of its nodes too, that of its own recording first, if it has nodes.
  // In other recordings, and other drives, more has to be shown by the shape:
  // there a longer path is sought. What they refer to must outlive the search.
  Query query;
  Query across;
  std::vector<History> histories;
  // The query's recording.
  std::size_t recording = 0;
  // How the frames of the histories lie to each other; null where all are of
  // one recording.
  std::shared_ptr<const FrameRelations> frames;
  const SearchOptions& options;
  double node_spacing_meters = 0.0;
  SearchPrior prior;
  const ShouldStop& should_stop;
  // The parts of alignments of the same query with each of the histories, with
  // the same options, or null.
  std::vector<AlignmentParts>* parts = nullptr;
  // The comparisons of the drive's own nodes (CandidateSet::comparisons), and
  // where to put all that are about to be made, or null.
  std::int64_t own_comparisons = 0;
  std::int64_t* comparisons = nullptr;
  // The frame of the first recording of the query's drive.
  std::size_t first_frame = 0;

  // The query as it is sought in a history.
  const Query& QueryIn(const History& history) const {
    return history.relation.is_own() ? query : across;
  }
};

// The directions that a search looks in: the same direction first.
std::vector<Direction> Directions(SearchDirection direction);

// The status of a search that was told to stop.
absl::Status StoppedError();

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_SEARCH_TASK_H_
