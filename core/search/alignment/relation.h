// How a history lies to the drive that asks about it: where its frame is, and
// how its errors go with those of the query. For a history node j and the query
// q it says what an alignment needs of the two together,
//
//   d_j      = x_q - T x_j               heading in (-pi, pi],
//   Gamma_qj = Cov(e_q - T e_j);
//
// T is the pose of the history's frame in the asking one, x an estimate and e
// its error. An alignment finds both in the axes of the history, where they are
// turned by T, which changes no odds and leaves the history as it is.
//
// There are two relations. That of a recording to its own past:
// - T is the identity.
// - Errors are those of one chain, so Gamma has the cross-covariance of q and j
//   that the noise model says (node_noise.h). The similarity kernel finds it
//   for whole blocks.
// - Node j lies before q in the same recording.
//
// And that to another recording (frame_relation.h), of the same drive or of
// another one, whose T is uncertain in one of several ways, each with its
// weight:
// - The ways of the frames as they are tied: T with the covariance P. Where no
//   closure ties them, one in twenty errs by three times as much, so that an
//   unlucky datum does not hide all of a recording.
// - Where nothing ties them, T is not known at all. Then no end is likelier
//   than another by where it lies: each of the nodes that the world may hold
//   (kWorldSquareMeters) is as likely.
// - The ways that marks of the drive have shown, each for the nodes near the
//   newest of its places, which alone counts: T updated as by a closure that
//   says no more than that two nodes are at one place.
//
// Beside a relation, only the following take query and history for one graph:
// Differences (differences.h), with the kernel and with what closures and marks
// have shown of the drift (known_drift.h, shown_drift.h), and the paper's
// alignment (composite_search.h).
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/node_noise.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"

namespace revisit::core {

// Places that the vehicle has probably passed before, and so a drift, or a pose
// of another frame, that is probable. Ends outside `reach` are compared as if
// it were not known: between passes far from the newest two nodes it is
// another.
struct WeighedDrift {
  // Nodes and where they were found, in the order of the nodes; not empty.
  std::vector<ConfirmedLoop> pairs;
  NodeRange reach;
  double log_weight = 0.0;
};

// Where recordings may lie that nothing ties, m^2: a city.
inline constexpr double kWorldSquareMeters = 1e8;

// Share of the relations of frames that no closure ties which err by
// kTailVariance times the variances.
inline constexpr double kTailShare = 0.05;
inline constexpr double kTailVariance = 9.0;

// One of the ways in which another frame may lie.
struct FrameWay {
  double log_weight = 0.0;
  // Multiplies the variances of T's own error.
  double fixed_scale = 1.0;
  // Whether T is not known; then the scale does not count.
  bool is_unknown = false;
};

// Immutable. Copies share what they hold.
class Relation {
 public:
  // The relation of a recording to its own past.
  Relation() = default;
  // The relation to another recording. `drifts` are the ways that marks have
  // shown, in falling order of their marks; their weights sum to less than 1.
  // The graphs of `frames` must outlive this.
  Relation(const RelatedFrames& frames, const FrameRelation& tie,
           std::vector<WeighedDrift> drifts);

  bool is_own() const { return other_ == nullptr; }

  // ---- The past of the query's own recording. REQUIRES: is_own().

  // d_j, for kOpposite with one of the headings turned by pi.
  Pose Difference(const SimilarityModel& model, const Pose& query,
                  const Pose& matched) const;

  // Gamma_qj, as claimed. O(1) where the noise model has a closed form, else
  // O(q - j).
  template <int D>
  StateMatrix<D> CovarianceOf(const Query& query,
                              const Correlation& correlation,
                              NodeIndex j) const;

  // The shares of Gamma_qj that are left of independent errors, for the nodes
  // of block k; false where all are 1 (FindUncorrelatedShares()).
  bool FindShares(const Query& query, const Correlation& correlation,
                  std::size_t k, BlockShares* shares) const;

  // Psi(i, i - 1), which carries the error of history node i - 1 on towards the
  // query. REQUIRES: i is at most the query's node.
  ErrorTransition TransitionTowards(const Query& query, NodeIndex i) const;

  // The first block from which the history's errors grow up to the query as
  // those of dead reckoning do (BlockBounds::FirstGrowing()). REQUIRES:
  // blocks <= BlocksBefore(), and the bounds have them.
  std::size_t FirstGrowing(const Query& query, const BlockBounds& bounds,
                           std::size_t blocks) const;

  // ---- Another recording. REQUIRES: !is_own().

  FrameState state() const { return other_->tie.state; }
  const RelatedFrames& frames() const { return other_->frames; }
  // The frames as they are tied, and the ways in which they may lie for it.
  const FrameRelation& tie() const { return other_->tie; }
  const std::vector<FrameWay>& ways() const { return *other_->ways; }
  // The ways that marks have shown.
  const std::vector<WeighedDrift>& drifts() const { return other_->drifts; }
  // The tie as the newest pair of a drift has shown it. Takes O(1), and is
  // another one for each scale of the claims.
  FrameRelation Shown(const WeighedDrift& drift, double drift_scale) const {
    return TiedBy(other_->frames, other_->tie, drift.pairs.back(), drift_scale);
  }

  // ---- Both.

  // A pose of the asking frame in the history's, as it is tied; as it is where
  // nothing ties them.
  Pose InHistory(const Pose& pose) const;

  // How many of the first blocks before node `end` of the history are full and
  // lie well before the query, so that none of their nodes is near it along the
  // path.
  std::size_t BlocksBefore(const Query& query, NodeIndex end) const;

 private:
  struct Other {
    RelatedFrames frames;
    FrameRelation tie;
    // Outlives this.
    const std::vector<FrameWay>* ways;
    std::vector<WeighedDrift> drifts;
  };

  std::shared_ptr<const Other> other_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_
