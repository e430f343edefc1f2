// How a confirmed loop closure shows the drift between other pairs of nodes.
//
// The closure (c, m) says that the true poses of c and m are one place, so
// their estimated difference y is the error e_c - e_m, up to a tolerance R_c.
// The error of another pair, e_q - e_j, is correlated with it:
//
//   X = Cov(e_q - e_j, e_c - e_m) = S_qc - S_qm - S_jc + S_jm,
//
// and given y it has the mean K y and the covariance Gamma_qj - K X^T, with
// K = X (Gamma_cm + R_c)^-1: the update of a Kalman filter.
//
// Where the closure was measured, y is the innovation and R_c the measurement's
// covariance, and the matched pose is carried to the query (confirmed_loop.h).
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_KNOWN_DRIFT_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_KNOWN_DRIFT_H_

#include <optional>

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// A pose of the closure, between this node and the next.
template <int D>
struct LoopEnd {
  NodeIndex index = 0;
  Pose pose;
  StateMatrix<D> covariance;
};

// The form that the kernel takes.
template <int D>
void FillRows(const StateMatrix<D>& matrix, double (&rows)[4][4]) {
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) rows[r][c] = matrix(r, c);
  }
}
template <int D>
KnownDriftTerms::LoopNode LoopNodeOf(const LoopEnd<D>& end) {
  KnownDriftTerms::LoopNode node{end.index, end.pose.x, end.pose.y, {}};
  FillRows<D>(end.covariance, node.covariance);
  return node;
}

template <int D>
LoopEnd<D> EndAt(const PoseGraph& graph, NodeIndex i);

// Whether the error at the later end can be the error at the earlier one,
// carried on, plus new noise of some covariance, up to a tolerance.
template <int D>
bool GrowsForward(const LoopEnd<D>& a, const LoopEnd<D>& b,
                  const StateMatrix<D>& tolerance);

// The drift between the query and any other node of the asking drive.
template <int D>
class KnownDrift {
 public:
  // Returns nothing where the covariances are not those of a forward filter
  // from one node of the closure over the other to the query, such as after an
  // optimiser has revised them: there
  //   S_later - Psi S_earlier Psi^T + R_c
  // is not positive definite, and the formulas above do not hold. Where that is
  // so for the covariance of a measurement only, the closure counts as if
  // nothing had been measured.
  // REQUIRES: NoiseModel::closures_show_drift: S is that of dead reckoning, in
  // O(1). The errors of other models have (nearly) decorrelated from the
  // closure's by the time it could be used.
  static std::optional<KnownDrift> Make(const Query& query,
                                        const SimilarityModel& model,
                                        const ConfirmedLoop& loop);

  // The known drift in the form that the kernel takes.
  KnownDriftTerms Terms() const;

  // Subtracts K y from the difference of the query and node j, and K X^T from
  // its covariance.
  void Apply(NodeIndex j, StateVector<D>* difference,
             StateMatrix<D>* covariance) const;

 private:
  // A closure as the formulas have it.
  struct Closure {
    LoopEnd<D> query;
    LoopEnd<D> matched;
    // y.
    StateVector<D> difference;
    // R_c, or nothing for kConfirmedTolerance.
    std::optional<StateMatrix<D>> measurement;

    StateMatrix<D> Tolerance() const;
  };

  static Closure Measured(const ConfirmedLoop& loop);
  static Closure Unmeasured(const PoseGraph& graph, SimilarityModel model,
                            const ConfirmedLoop& loop);
  static std::optional<KnownDrift> Make(const Query& query,
                                        const SimilarityModel& model,
                                        const Closure& closure);

  KnownDrift(const PoseGraph& graph, const Closure& closure,
             double variance_scale)
      : graph_(&graph), closure_(closure), variance_scale_(variance_scale) {}

  // S_i,end.
  StateMatrix<D> CrossWith(NodeIndex i, const LoopEnd<D>& end) const;

  const PoseGraph* graph_;
  Closure closure_;
  double variance_scale_;
  // S_qc - S_qm
  StateMatrix<D> query_part_;
  // (Gamma_cm + R_c)^-1
  StateMatrix<D> information_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_KNOWN_DRIFT_H_
