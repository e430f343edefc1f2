// The drift between a drive and its own past as the marks of the drive have
// shown it (mark.h).
//
// Nodes c_1, ..., c_n were found at the places m_1, ..., m_n. Each pair says,
// as a closure does where nothing was measured, that the two nodes are at one
// place up to R = kConfirmedTolerance. Drift turns the new part of a drive
// against the old one, and at the end of a lever arm of a kilometre a linear
// update (known_drift.h) is off by metres. So the past is compared as if it
// were in another frame (frame_relation.h): T carries it to where the drive now
// sees it, by a rigid motion, and its error has the covariance P between the
// nodes c_n and m_n.
//
// - The first pair updates T = 1, whose error is what the poses have added from
//   m_1 to c_1, seen at the place m_1.
// - Each later pair updates the tie before it, to whose error comes what the
//   poses have added from c_k-1 to c_k and between m_k-1 and m_k. A pair that
//   contradicts the tie (its innovation is beyond what one in a hundred true
//   ones has) begins anew from the claims.
//
// Kalman's updates all; neighbouring pairs count as independent, although they
// share some of their path: what that makes too sure, R covers, which is wider
// than most pairs err.
//
// A node j after m_n, up to c_n, lies on the way over which the drift came to
// be, and has some of it already. With u_i the error that was added from m_n to
// node i, Q_i its covariance and Psi the lever arm of dead reckoning from j to
// c_n,
//
//   Cov(u_j, u_c) = Q_j Psi^T,
//
// and u_c = y is known from T up to P, carried from m_n to c_n. So the estimate
// of j is corrected by K y with K = Q_j Psi^T (Q_c + P)^-1, and its covariance
// is less by K Psi Q_j. P counts as independent of it, which overstates the
// covariance of nodes close to c_n by up to P.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SHOWN_DRIFT_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SHOWN_DRIFT_H_

#include <optional>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

template <int D>
class ShownDrift {
 public:
  // `pairs`: nodes and where they were found, in the order of the nodes, none
  // of which lies after the query's. Those over which covariances do not grow
  // as a forward filter's do (known_drift.h) do not count; nothing if none
  // does. REQUIRES: NoiseModel::closures_show_drift; matched nodes lie before
  // theirs; the query's graph outlives this.
  static std::optional<ShownDrift> Make(
      const Query& query, const SimilarityModel& model,
      const std::vector<ConfirmedLoop>& pairs);

  FrameNodes nodes() const {
    return {*graph_, model_.state_space, model_.correlation};
  }
  // How the past lies to the drive. P is that of this scale of the claims.
  const FrameRelation& tie() const { return *tie_; }

  // The drift shown as far as nodes after m_n have it, in the
  // form that the kernel takes: K y is added to their differences from the
  // query, K Psi Q_j subtracted from the covariances.
  KnownDriftTerms Bridge() const;

 private:
  ShownDrift(const PoseGraph& graph, const SimilarityModel& model)
      : graph_(&graph), model_(model) {}

  double variance_scale() const { return model_.inflation * model_.inflation; }
  // Q_c: what was added between the two nodes of a pair.
  StateMatrix<D> AddedOver(const ConfirmedLoop& pair) const;
  FrameRelation AsClaimed(const ConfirmedLoop& pair) const;
  // The tie after a pair, or nothing where the pair contradicts it.
  std::optional<FrameRelation> Updated(const FrameRelation& tie,
                                       const ConfirmedLoop& pair,
                                       bool may_contradict) const;
  void Learn(const ConfirmedLoop& pair);

  const PoseGraph* graph_;
  SimilarityModel model_;
  // Nothing before the first pair.
  std::optional<FrameRelation> tie_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SHOWN_DRIFT_H_
