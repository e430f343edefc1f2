// How well the end poses agree (the anchor of relative.h), block by block:
// under each scale of the claims and each drift that a model holds possible,
// and under their mixture.
//
// The density of the difference of the query and node j is
//
//   sum over scales k, drifts h of  v_k w_h N(d_kh; 0, Gamma_kh + R),
//
// where h = 0 is the drift as claimed, and in the others d and Gamma are those
// of a history that was laid to where marks have shown it (shown_drift.h). A
// drift that node j lies out of the reach of counts as the drift as claimed
// there. In another recording, h = 0 is
// a sum over the ways in which its frame may lie (relation.h).
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_ANCHORS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_ANCHORS_H_

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/differences.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/search_bounds.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

template <int D>
class Anchors {
 public:
  // All must outlive this.
  Anchors(const Query& query, const History& history,
          const RelativeModel& model, const RecentPath<D>& recent,
          const PathAxes<D>& axes, Direction direction);

  // Compares the query with the first `count` nodes of block k; what else is
  // told concerns these. `next` is the block that will be asked for after it.
  // REQUIRES: where the noise model has no closed form, k falls from call to
  // call.
  void Find(std::size_t k, std::size_t count, std::size_t next);

  // The same for nodes from anywhere, copied to a block of their own: those of
  // blocks that the same drifts reach into as into the one that begins at node
  // `first`. REQUIRES: NoiseModel::neighbours_err_alike.
  void FindAmong(const NodeBlock& nodes, const BlockColumn& indices,
                 std::size_t count, NodeIndex first);

  // Whether the covariance of node i of the block is well-conditioned.
  bool IsPossible(std::size_t i) const;

  // Whether no variance of either node is more than twice that of the other.
  bool AreAlike(std::size_t i, std::size_t j) const;

  // For each node, the most that the log-odds can come to, but for what a path
  // gains: of this end alone, or of any near it (SearchBounds::BoundEnds()).
  // Undefined for nodes that are not possible.
  void Bound(const SearchBounds<D>& bounds, BoundOf of, BlockColumn* most);

  // Whether the log-odds of node i, but for what is the same for all ends and
  // what its path gains, can come to `least`, once a path of so many steps has
  // shifted its difference by `shift`, in the axes of the vehicle at the end,
  // and as far as it may shift it further; nothing for a path that has ended.
  // True where nothing is known. REQUIRES: Bound() came after the nodes were
  // found, Change() not.
  bool MayReach(std::size_t i, const StateVector<D>& shift,
                std::optional<std::int64_t> steps, double least);

  // Changes the differences by what paths have shown.
  void Change(const DifferenceChange& change);

  // The mixture at a node, and the part of it that is most probable there.
  struct Mixture {
    double log_similarity = kImpossible;
    double squared_mahalanobis = 0.0;
    double scale = 1.0;
    // In another recording: its place among the relation's ways, and behind
    // these among its drifts.
    std::size_t way = 0;
  };
  // REQUIRES: i is possible.
  Mixture At(std::size_t i) const;

  // The log-similarity under each scale alone, kImpossible where it is
  // ill-conditioned. REQUIRES: there are no drifts.
  void AppendScales(std::size_t i, std::vector<double>* log_similarities) const;

 private:
  // The axes of a part of its own, and what MayReach() needs in them.
  struct Axes {
    std::unique_ptr<const PathAxes<D>> own;
    std::optional<std::int64_t> further_after;
    double further[kMostEntries] = {};
  };

  struct Part {
    // Leaves all else as it is until nodes are found: to clear so much takes
    // longer than to make the rest.
    explicit Part(const WeighedScale& of)
        : scale(of.scale), log_scale_weight(of.log_weight) {}

    // Nothing where it is not known how the frames lie to each other.
    std::optional<Differences<D>> finder;
    // The query's heading in the history's frame, as this part has it, if it
    // has axes of its own.
    double heading = 0.0;
    std::size_t axes = 0;
    std::size_t way = 0;
    double log_way_weight = 0.0;
    double scale;
    double log_scale_weight;
    // Nothing for the drift as claimed.
    const WeighedDrift* drift = nullptr;
    // In the block at hand. A part that does not count there has no weight.
    bool counts = true;
    double log_weight = 0.0;
    DifferenceBlock differences;
    BlockSimilarity similarity;
    // BoundChanged() of it.
    BlockColumn unshifted;
  };

  void AddParts(const Query& query, const History& history,
                const SimilarityModel& similarity, const WeighedScale& scale);
  void AddOwnParts(const Query& query, const History& history,
                   const SimilarityModel& similarity,
                   const WeighedScale& scale);
  void AddTiedParts(const Query& query, const History& history,
                    const SimilarityModel& similarity,
                    const WeighedScale& scale);
  void TurnAxes(const Query& query, const FrameRelation& tie, Part* part);
  bool PartMayReach(const Part& part, std::size_t i,
                    const StateVector<D>& shift,
                    std::optional<std::int64_t> steps, double least);
  void Weigh(NodeIndex first);
  void Evaluate(Part* part);
  const PathAxes<D>& AxesOf(const Part& part);
  const double* FurtherShift(const Part& part,
                             std::optional<std::int64_t> steps);

  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const PathAxes<D>& axes_;
  // model_.drifts, or what the relation knows.
  const std::vector<WeighedDrift>& drifts_;
  std::vector<Part> parts_;
  // Entry 0 is for axes_; the others, for parts that see the path turned.
  std::vector<Axes> part_axes_;
  // Nodes that are told of.
  std::size_t count_ = 0;
  // The logarithm of how many parts count, and the one by which an end could
  // last reach what was asked for.
  double log_counting_ = 0.0;
  std::size_t reached_ = 0;
  // Scratch: the bound of each part.
  std::vector<BlockColumn> part_bounds_;
};

// Whether a drift reaches into the block that begins at node `first`.
bool Reaches(const WeighedDrift& drift, NodeIndex first);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_ANCHORS_H_
