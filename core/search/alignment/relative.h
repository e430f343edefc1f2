// Aligns the recent path with the history so that drift counts once.
//
// From the two ends both paths are walked back together, and what counts is how
// far their shapes stray from each other and how rare they are
// (shape_filter.h). The difference of the two ends, as estimated from the whole
// path, is weighed once by its own covariance (the anchor). For history
// node j,
//
//   score(j) = ln N(d_j + a; 0, Gamma_j + R - A) + w LLR(q) - c - b - ln rho,
//
// the log-odds of "the end is at node j" against "at no node of the history".
// - q is the path of history back from j with the greatest LLR (path_walk.h),
//   of any length up to the recent path's: the vehicle may have joined the old
//   road only just now.
// - LLR is the accumulated log-likelihood ratio of the shape, less a cost for
//   each slip; w discounts it for what neighbouring nodes share. c is the cost
//   of a place at which roads join, which LLR has back where q covers all of
//   the recent path (kJoinCost).
// - b is by how much shapes and headings are alike by chance (chance.h), in
//   other recordings where other drives are searched; else 0.
// - a is how far the end poses stray by themselves, as the smoother has it
//   after q, and A is by how much that is more certain than R says. Both are 0
//   where q is the end alone. This is the joint density of the whole window,
//   factored: the shape with nothing known of the drift, times the drift that
//   the shape has shown.
// - d_j and Gamma_j are the difference and the covariance of the two nodes,
//   given what the last confirmed loop closure has shown of the drift
//   (known_drift.h).
// - rho is the density of nodes on roads not driven (LogNewPlaceTerm()).
//
// Where scales or drifts are uncertain, N is their mixture (anchors.h).
//
// Ends do not depend on each other, so only those that can matter need be
// looked at: see RelativeModel::least_log_share and search_bounds.h.
//
// Where drift fills the town, nearly all ends can matter together, but few by
// themselves. An end whose log-odds are surely below
// RelativeModel::most_log_odds_sampled, or far below the best that was found,
// may be sampled: of the ends around it, one is looked at, which stands for all
// of them (ScoredEnd::nodes). This is an approximation. Others are found to the
// last bit, but bounds of the log-odds take it that
// - positions and covariances change slowly from node to node: around a jump,
//   and where covariances of neighbouring samples are not alike, nothing is
//   sampled;
// - a path is off by few slips at a time (heading_match.h).
// The samples are chosen by the nodes' numbers, so that the same search finds
// the same.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_H_

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/found_ends.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/path_walk.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/scored_ends.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/should_stop.h"

namespace revisit::core {

class RelativeAlignment {
 public:
  // Walks the best path back from an end once more.
  using Trace = std::function<std::vector<PathStep>(Direction, NodeIndex)>;

  // There are no ends.
  RelativeAlignment() = default;
  // The ends that were found, by IndexOf(direction).
  RelativeAlignment(std::array<MatchedEnds, 2> found, NodeIndex considered,
                    Trace trace)
      : found_(std::move(found)),
        considered_(considered),
        trace_(std::move(trace)) {}

  // Ends with their log-odds, sorted by node, without those whose Gamma is
  // ill-conditioned and those for which another stands. Empty for a direction
  // that was not sought.
  const ScoredEnds& ends(Direction direction) const {
    return found_[IndexOf(direction)].ends;
  }
  // REQUIRES: j is among the ends.
  const ShapeMatch& match(Direction direction, NodeIndex j) const;

  // With RelativeModel::tell_scales: the log-odds of each end under each scale
  // alone, in the order of the ends.
  const std::vector<double>& odds_by_scale(Direction direction) const {
    return found_[IndexOf(direction)].odds_by_scale;
  }

  // The best path back from j, the end first, which is walked once more for it.
  // REQUIRES: j is among the ends; the graph is as it was.
  std::vector<PathStep> Path(Direction direction, NodeIndex j) const {
    return trace_(direction, j);
  }

  // Nodes of the history that were not pruned: walked from in either direction,
  // counted by one that stands for them, excluded by not_sought, or
  // ill-conditioned. All of them if least_log_share
  // prunes nothing.
  NodeIndex considered() const { return considered_; }

 private:
  std::array<MatchedEnds, 2> found_;
  NodeIndex considered_ = 0;
  Trace trace_;
};

// Aligns the recent path of the query with the history. Time O(steps *
// history's size) at most, less where shapes differ early, and less still where
// ends are pruned. Returns nothing if told to stop. REQUIRES: the recent path
// lies in one segment, and may begin in the history; the history's graph
// outlives the answer. `parts`, if not null, are empty or come from an
// alignment of the same query and the same nodes of the history, whichever are
// sought, and a model with the same similarity, shape and spacings; the axes
// also of the same relation.
std::optional<RelativeAlignment> AlignRelative(const Query& query,
                                               const History& history,
                                               const RelativeModel& model,
                                               const ShouldStop& should_stop,
                                               AlignmentParts* parts = nullptr);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_H_
