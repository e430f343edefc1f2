// The answer of a search: candidates for the place of a node, with the evidence
// for each.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_CANDIDATE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_CANDIDATE_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/frame_state.h"
#include "core/drive/node_index.h"
#include "core/noise/comparison.h"
#include "core/search/belief/scale_estimate.h"
#include "core/search/candidates/gate_result.h"
#include "core/search/candidates/relative_evidence.h"
#include "core/search/candidates/verdict.h"

namespace revisit::core {

struct Candidate {
  // 1 for the best.
  int rank = 0;
  // Composite: log-likelihood of the best alignment that ends at the matched
  // node, less a constant. Relative: log-odds of the matched node against all
  // places not seen before.
  double score = 0.0;
  // The drive of the scope in which the matched node lies; nothing for the one
  // that asks.
  std::optional<std::size_t> drive = std::nullopt;
  // The matched node, and how its frame is tied to that of the query.
  NodeIndex matched = 0;
  FrameState frame_state = FrameState::kSame;
  Direction direction = Direction::kSame;
  Verdict verdict = Verdict::kIllConditioned;
  // In the query's frame. Nothing where nothing tells how the frames lie to
  // each other.
  std::optional<GatedDifference> difference;
  // The factor by which the claimed standard deviations were multiplied for the
  // difference and its gate.
  double inflation = 1.0;
  // For relative alignments only.
  std::optional<RelativeEvidence> relative;
  // The alignment, oldest first: (node of the recent path, node of the
  // history). Empty unless SearchOptions::tell_paths is set.
  std::vector<std::pair<NodeIndex, NodeIndex>> path;
};

// Why there are no candidates. Reasons are numbered from 0 without gaps.
enum class EmptyReason {
  // There are candidates.
  kNotEmpty,
  // From the start or the last jump to the query, the path is shorter than the
  // sequence.
  kPathTooShort,
  // No nodes lie before the sequence.
  kNoHistory,
  // Every node before the sequence is within the separation of the query.
  kAllSuppressed,
  // No path of the history is as long as the sequence, or Gamma is
  // ill-conditioned along all of them.
  kNoAlignment,
  // No node could come to odds that matter: see nodes_pruned.
  kNoProbablePlace,
  // More than SearchOptions::max_comparisons.
  kTooMuchWork,
};

// Why a drive of the scope is not searched. Reasons are numbered from 0 without
// gaps.
enum class UnsearchedReason {
  // It has another one than the drive that asks; nor are other drives searched
  // with another noise model than the drive's own.
  kStateSpace,
  kNoiseModel,
  kNodeSpacing,
  // Composite alignments know no frame but their own.
  kAlignment,
};

struct UnsearchedDrive {
  // Its index in the scope.
  std::size_t drive = 0;
  UnsearchedReason reason = UnsearchedReason::kStateSpace;
};

struct CandidateSet {
  // The node that was asked about; nothing if the graph is empty.
  std::optional<NodeIndex> query;
  // Best score first; of equal scores, the first history first, of one history
  // the same direction first, and of one direction the lower node.
  std::vector<Candidate> candidates;
  EmptyReason empty_reason = EmptyReason::kNotEmpty;
  // Nodes of all histories that were compared with the query, and nodes that
  // were not: all of the latter together have odds below 1e-6 against a new
  // place.
  NodeIndex nodes_considered = 0;
  NodeIndex nodes_pruned = 0;
  // The number that SearchOptions::max_comparisons bounds.
  std::int64_t comparisons = 0;
  // The drives of the scope that were not searched, in their order.
  std::vector<UnsearchedDrive> unsearched;
  // For relative alignments only: posterior probability that the query is at no
  // place of any history.
  std::optional<double> new_place_probability;
  // The scale that the drive has shown, where that was used.
  std::optional<ScaleEstimate> scale;
};

// Sorts candidates, best first, and keeps at most `count`. Equal scores keep
// their order.
void KeepBest(int count, std::vector<Candidate>* candidates);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_CANDIDATE_H_
