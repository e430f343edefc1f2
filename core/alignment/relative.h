// Aligns the recent path with the history so that drift counts once.
//
// From the two ends both paths are walked back together, and what counts is how
// far their shapes stray from each other and how rare they are
// (shape_filter.h). The difference of the two ends, as the whole of the path
// tells it, is weighed once by its own covariance (the anchor). For history
// node j,
//
//   score(j) = ln N(d_j + a; 0, Gamma_j + R - A) + w LLR(q) - ln rho,
//
// the log-odds of "the end is at node j" against "at no node of the history".
// - q is the path of history back from j with the greatest LLR, of any length
//   up to the recent path's: the vehicle may have joined the old road only just
//   now. A path ends where the next innovation lies beyond
//   kSquaredInnovationLimit.
// - LLR is the accumulated log-likelihood ratio of the shape, less a cost for
//   each slip; w discounts it for what neighbouring nodes share.
// - a is how far the end poses stray by themselves, as the smoother has it
//   after q, and A by how much that is more certain than R says. Both 0 where q
//   is the end alone. This is the joint density of the whole window, factored:
//   shape with nothing known of the drift, times the drift that the shape has
//   shown.
// - d_j and Gamma_j are those of the two nodes, given what the last confirmed
//   loop closure has shown of the drift (known_drift.h).
// - rho is the density of nodes on roads not driven, per m^2 and rad: roads at
//   a mean distance B hold 2 / B metres of road a square metre, with nodes at
//   spacing s, and each can be driven both ways:
//     rho = (2 / B) (1 / s) 2 / (2 pi) = 2 / (pi B s).
//   SPATIAL: spread evenly over kRoadHeightRange.
//
// Paths walk the graph: to the node before; over a confirmed loop closure,
// where the two passes are taken for one place and the other pass is walked on;
// and, where the odometers of the two passes disagree, staying at a node or
// skipping one, if that step is then the likelier by more than kSlipCost. Each
// end has its own paths, which carry their drift with them: one, and one more
// for each loop closure that is crossed. Of the paths of one end that meet
// after a loop closure the likelier is walked on, and of all at most
// kMostPaths. Opposite passes walk the history forward in time with all
// headings turned by pi.
//
// Since ends do not depend on each other, only those that can matter need be
// looked at: see RelativeModel::least_log_share.
#ifndef REVISIT_CORE_ALIGNMENT_RELATIVE_H_
#define REVISIT_CORE_ALIGNMENT_RELATIVE_H_

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "core/alignment/known_drift.h"
#include "core/alignment/log_similarity.h"
#include "core/alignment/scored_ends.h"
#include "core/alignment/shape_filter.h"
#include "core/alignment/viterbi.h"
#include "core/graph/block_bounds.h"
#include "core/graph/motion_history.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Roads not driven are taken to lie within this range of height, m.
inline constexpr double kRoadHeightRange = 20.0;

// What a slip (a node stayed at, or skipped) costs: odometers that agree to one
// in a hundred slip once in a hundred nodes, and -ln(1/100) is 4.6.
inline constexpr double kSlipCost = 4.6;

// Innovations beyond this squared Mahalanobis distance end the overlap of two
// paths. On the same road chi-square with 3 degrees of freedom exceeds it once
// in 900 steps.
inline constexpr double kSquaredInnovationLimit = 16.0;

// Paths of one end that are walked on side by side.
inline constexpr std::size_t kMostPaths = 4;

struct RelativeModel {
  // Of the anchor.
  SimilarityModel similarity;
  ShapeModel shape;
  double spacing_meters = 2.0;
  double road_spacing_meters = 200.0;
  bool same_direction = true;
  bool opposite_direction = false;
  // What is known of the drift. kDeadReckoning only; both nodes at or before
  // the query.
  std::optional<ConfirmedLoop> last_confirmed;
  // No ends: left out. May overlap.
  std::vector<NodeRange> not_sought;
  // Ends are left out whose odds are below this share (its logarithm) of the
  // greatest, or of a new place's odds of 1 if that is more. With this above
  // -infinity, they are not looked at where that can be told: by where their
  // block lies, by their own pose and covariance, by a path that cannot make up
  // for it.
  double least_log_share = kImpossible;
  // Of the graph, if they are kept: the one saves measuring its motion anew,
  // the other looking at every node.
  const MotionHistory* motion_history = nullptr;
  const BlockBounds* block_bounds = nullptr;
};

// What makes log-odds against a new place of a log-similarity in Gaussian form:
// the Gaussian's constant, less ln rho.
double LogNewPlaceTerm(const RelativeModel& model);

// The best path back from one history node.
struct ShapeMatch {
  double log_likelihood_ratio = 0.0;
  // Sum over its steps.
  double squared_innovations = 0.0;
  // (d + a)^T (Gamma + R - A)^-1 (d + a): the end's difference as the whole
  // path tells it.
  double squared_end_difference = 0.0;
  // Steps of the recent path it covers; 0 for the end alone.
  std::int64_t steps = 0;
};

// A step of a path: t steps back from the recent path's end, the node it is at
// and the way it walks there.
struct PathStep {
  std::int64_t t = 0;
  NodeIndex node = 0;
  Direction direction = Direction::kSame;

  bool operator==(const PathStep& other) const {
    return t == other.t && node == other.node && direction == other.direction;
  }
};

// Walks back from single ends once more.
class PathFinder {
 public:
  virtual ~PathFinder() = default;
  virtual std::vector<PathStep> Find(Direction direction,
                                     NodeIndex j) const = 0;
};

class RelativeAlignment {
 public:
  // Ends with their log-odds, sorted by node; none whose Gamma is
  // ill-conditioned. Empty for a direction that was not sought.
  const ScoredEnds& ends(Direction direction) const {
    return ends_[IndexOf(direction)];
  }
  // REQUIRES: j is among the ends.
  const ShapeMatch& match(Direction direction, NodeIndex j) const;

  // The best path back from j, the end first. REQUIRES: j is among the ends;
  // the graph is as it was.
  std::vector<PathStep> Path(Direction direction, NodeIndex j) const {
    return paths_->Find(direction, j);
  }

  // Nodes of history from which paths were walked back, either way, of which
  // nothing can be said, or which were not sought. All of them unless ends are
  // left out for their odds.
  NodeIndex considered() const { return considered_; }

 private:
  template <int D>
  friend class RelativeAligner;

  std::array<ScoredEnds, 2> ends_;
  // As ends_.
  std::array<std::vector<ShapeMatch>, 2> matches_;
  std::shared_ptr<const PathFinder> paths_;
  NodeIndex considered_ = 0;
};

// Aligns the `steps` nodes that end at `query` with the history [0,
// history_size). Time O(steps * history_size) at most, less where shapes differ
// early, and less still where ends are left out. Nothing if told to stop.
// REQUIRES: as for Align(); the recent path lies in one segment; the graph
// outlives the answer.
std::optional<RelativeAlignment> AlignRelative(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop);

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_RELATIVE_H_
