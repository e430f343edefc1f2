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
#ifndef REVISIT_CORE_ALIGNMENT_KNOWN_DRIFT_H_
#define REVISIT_CORE_ALIGNMENT_KNOWN_DRIFT_H_

#include <optional>

#include "core/alignment/log_similarity.h"
#include "core/alignment/similarity_kernel.h"
#include "core/geometry/pose.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// R_c: a verifier confirms that two poses are at one place, which is some 10 m
// wide (two standard deviations), but not how they lie to each other.
inline constexpr PlaceTolerance kConfirmedTolerance{5.0, 0.15};

struct ConfirmedLoop {
  NodeIndex query = 0;
  NodeIndex matched = 0;
};

// The direction in which a loop was closed, judged by the headings.
Direction DirectionOf(const PoseGraph& graph, const ConfirmedLoop& loop);

// The drift between one query node and any other node.
template <int D>
class KnownDrift {
 public:
  // Returns nothing where the covariances are not those of a forward filter
  // from one node of the closure over the other to the query, such as after an
  // optimiser has revised them: there
  //   S_later - Psi S_earlier Psi^T + R_c
  // is not positive definite, and the formulas above do not hold.
  // REQUIRES: kDeadReckoning, where S is O(1). The errors of other models have
  // (nearly) decorrelated from the closure's by the time it could be used.
  static std::optional<KnownDrift> Make(const PoseGraph& graph,
                                        const SimilarityModel& model,
                                        const ConfirmedLoop& loop,
                                        NodeIndex query);

  // The known drift in the form that the kernel takes.
  KnownDriftTerms Terms() const;

  // Subtracts K y from the difference of the query and node j, and K X^T from
  // its covariance.
  void Apply(NodeIndex j, StateVector<D>* difference,
             StateMatrix<D>* covariance) const;

 private:
  KnownDrift(const PoseGraph& graph, const ConfirmedLoop& loop,
             double variance_scale)
      : graph_(&graph), loop_(loop), variance_scale_(variance_scale) {}

  const PoseGraph* graph_;
  ConfirmedLoop loop_;
  double variance_scale_;
  // S_qc - S_qm
  StateMatrix<D> query_part_;
  // (Gamma_cm + R_c)^-1
  StateMatrix<D> information_;
  StateVector<D> loop_difference_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_KNOWN_DRIFT_H_
