// How a history lies to the drive that asks about it: where its frame is, and
// how its errors go with those of the query. For a history node j and the query
// q it says what an alignment needs of the two together,
//
//   d_j      = x_q - T x_j               heading in (-pi, pi],
//   Gamma_qj = Cov(e_q - T e_j),
//
// in the axes of the asking drive's frame; T is the pose of the history's frame
// in it, x an estimate and e its error.
//
// There is one relation, that of a drive to its own past:
// - T is the identity.
// - Errors are those of one chain, so Gamma has the cross-covariance of q and j
//   that the noise model says (node_noise.h). The similarity kernel finds it
//   for whole blocks.
// - Node j of the history is node j of the asking drive, now or as it was, and
//   lies before q: distances along the path and cross-covariances are those of
//   the asking drive.
//
// Whoever needs any of this asks a relation. Beside it, only the following take
// the two for one graph: Differences (differences.h), with the kernel and with
// what closures have shown of the drift (known_drift.h), and the paper's
// alignment (composite_search.h). Within one history, distances along the path
// and loop closures are those of its own graph.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_

#include <cstddef>

#include "core/drive/block_bounds.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"

namespace revisit::core {

// Thread-safe: it has no state.
class Relation {
 public:
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

  // A pose of the asking drive, in the history's frame.
  Pose InHistory(const Pose& pose) const { return pose; }

  // How many of the history's first blocks are full and lie well before the
  // query, so that none of their nodes is near it along the path.
  std::size_t BlocksBefore(const Query& query, NodeIndex history_size) const;

  // The first block from which the history's errors grow up to the query as
  // those of dead reckoning do (BlockBounds::FirstGrowing()). REQUIRES:
  // blocks <= BlocksBefore(), and the bounds have them.
  std::size_t FirstGrowing(const Query& query, const BlockBounds& bounds,
                           std::size_t blocks) const;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RELATION_H_
