// How the errors of two nodes are correlated, and the covariance of their
// difference (paper, Eq. 3).
//
// For any forward filter the error obeys e_j = Psi(j,i) e_i + (noise
// independent of e_i) for i before j, so the cross-covariance S_ij = S_ii
// Psi(j,i)^T follows from the covariance of the earlier node alone:
//
//   Gamma_ij = S_ii + S_jj - S_ii Psi(j,i)^T - Psi(j,i) S_ii.
//
// Fixes that depend on each other, since reflections or a smoother behind them
// change slowly, have errors of a first-order Gauss-Markov process over the
// travelled distance s:
//
//   Gamma_ij = (1 - r) (S_ii + S_jj),   r = g exp(-|s_j - s_i| / L),
//
// with L the distance over which errors decorrelate. g <= 1 is the ratio of the
// geometric to the arithmetic mean of the two nodes' variances, of the position
// in the plane or of the heading, whichever is less: where one covariance is a
// multiple of the other, Gamma is that of the process exactly. It is positive
// definite for any two nodes, and tends to that of independent errors. The
// process: Gelb, "Applied Optimal Estimation" (1974), 3.6.
#ifndef REVISIT_CORE_DRIVE_CORRELATION_H_
#define REVISIT_CORE_DRIVE_CORRELATION_H_

#include <array>
#include <cstddef>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"

namespace revisit::core {

enum class CorrelationModel {
  // Psi carries the heading error over the lever arm between the two positions:
  // it is the identity except for the column of heading, which is J (p_j - p_i)
  // in x and y, with J the turn by a right angle.
  kDeadReckoning,
  // Psi = 0.
  kIndependent,
  // Psi is the product of the nodes' error transitions.
  kFilter,
  // Gauss-Markov, as above.
  kCorrelatedFixes,
};

// A model with its parameter.
struct Correlation {
  Correlation() = default;
  // Implicit, since most models have no parameter.
  Correlation(CorrelationModel of, double over_meters = kUsualMeters)
      : model(of), meters(over_meters) {}

  // Some 30 s of a car in a city, for which reflections between buildings and
  // the smoothing of receivers last.
  static constexpr double kUsualMeters = 300.0;

  CorrelationModel model = CorrelationModel::kDeadReckoning;
  // L, for kCorrelatedFixes only.
  double meters = kUsualMeters;
};

// Whether both mean the same: the parameter counts where the model has it.
inline bool operator==(const Correlation& a, const Correlation& b) {
  return a.model == b.model && (a.model != CorrelationModel::kCorrelatedFixes ||
                                a.meters == b.meters);
}
inline bool operator!=(const Correlation& a, const Correlation& b) {
  return !(a == b);
}

// A product of error transitions with no entry above this counts as zero: the
// errors have decorrelated. Entries of different units are compared as they are
// in metres and radians.
inline constexpr double kDecorrelatedNorm = 1e-9;

// Psi(later, earlier). O(1), but O(later - earlier) for kFilter.
// REQUIRES: earlier <= later; the model is not kCorrelatedFixes.
template <int D>
StateMatrix<D> PropagatedError(const PoseGraph& graph, CorrelationModel model,
                               NodeIndex earlier, NodeIndex later);

// 1 - r for two fixes of these covariances, so far apart along the path: the
// share of S_ii + S_jj that is left in their difference.
double UncorrelatedShare(const Covariance& a, const Covariance& b,
                         double meters_apart, const Correlation& correlation);

// Shares of the nodes of block k, against the query. Returns false, and leaves
// them as they are, where all of them are 1: the errors have decorrelated, as
// they have in any other model.
using BlockShares = std::array<double, NodeBlock::kSize>;
bool FindUncorrelatedShares(const PoseGraph& graph,
                            const Correlation& correlation, NodeIndex query,
                            std::size_t k, BlockShares* shares);

// Psi for kDeadReckoning, which depends on the two poses alone.
template <int D>
StateMatrix<D> DeadReckoningTransition(const Pose& earlier, const Pose& later) {
  StateMatrix<D> psi = StateMatrix<D>::Identity();
  psi(0, D - 1) = -(later.y - earlier.y);
  psi(1, D - 1) = later.x - earlier.x;
  return psi;
}

// Gamma from the two covariances and Psi.
template <int D>
StateMatrix<D> DifferenceCovariance(const StateMatrix<D>& earlier_covariance,
                                    const StateMatrix<D>& later_covariance,
                                    const StateMatrix<D>& psi) {
  const StateMatrix<D> carried = psi * earlier_covariance;
  return earlier_covariance + later_covariance - carried - carried.transpose();
}

// Gamma for kDeadReckoning, in closed form. With h the index of heading and l
// the lever arm J (p_later - p_earlier), which is 0 except in x and y, Psi is
// I + l e_h^T and
//
//   Gamma(r,c) = later(r,c) - earlier(r,c)
//                - (l_r earlier(h,c) + l_c earlier(h,r)).
template <int D>
StateMatrix<D> DeadReckoningDifferenceCovariance(
    const Pose& earlier, const Pose& later,
    const StateMatrix<D>& earlier_covariance,
    const StateMatrix<D>& later_covariance) {
  const double lever[2] = {-(later.y - earlier.y), later.x - earlier.x};
  constexpr int h = D - 1;
  StateMatrix<D> gamma;
  for (int c = 0; c < D; ++c) {
    for (int r = c; r < D; ++r) {
      double entry = later_covariance(r, c) - earlier_covariance(r, c);
      if (r < 2) {
        entry -= lever[r] * earlier_covariance(h, c) +
                 lever[c] * earlier_covariance(h, r);
      } else if (c < 2) {
        entry -= lever[c] * earlier_covariance(h, r);
      }
      gamma(r, c) = gamma(c, r) = entry;
    }
  }
  return gamma;
}

// Gamma of two nodes in any order. O(1), but O(|i - j|) for kFilter.
template <int D>
StateMatrix<D> DifferenceCovariance(const PoseGraph& graph,
                                    const Correlation& correlation, NodeIndex i,
                                    NodeIndex j);

// S_ij, the cross-covariance of two nodes in any order. O(1), but O(|i - j|)
// for kFilter.
template <int D>
StateMatrix<D> CrossCovariance(const PoseGraph& graph,
                               const Correlation& correlation, NodeIndex i,
                               NodeIndex j);

// Calls visit(i, Gamma) for the query node and each node i in [0, count), in
// any order. O(count) in every model. REQUIRES: count <= query.
template <int D, typename Visit>
void VisitDifferenceCovariances(const PoseGraph& graph,
                                const Correlation& correlation, NodeIndex query,
                                NodeIndex count, const Visit& visit) {
  const Pose query_pose = graph.pose(query);
  const StateMatrix<D> query_covariance = ToMatrix<D>(graph.covariance(query));
  const auto call = [&](NodeIndex i, const StateMatrix<D>& psi) {
    visit(i, DifferenceCovariance<D>(ToMatrix<D>(graph.covariance(i)),
                                     query_covariance, psi));
  };
  switch (correlation.model) {
    case CorrelationModel::kDeadReckoning:
      for (NodeIndex i = 0; i < count; ++i) {
        visit(i, DeadReckoningDifferenceCovariance<D>(
                     graph.pose(i), query_pose,
                     ToMatrix<D>(graph.covariance(i)), query_covariance));
      }
      return;
    case CorrelationModel::kIndependent:
      for (NodeIndex i = 0; i < count; ++i) call(i, StateMatrix<D>::Zero());
      return;
    case CorrelationModel::kCorrelatedFixes:
      for (NodeIndex i = 0; i < count; ++i) {
        visit(i, DifferenceCovariance<D>(graph, correlation, i, query));
      }
      return;
    case CorrelationModel::kFilter: {
      // One product, run backward from the query past every node.
      StateMatrix<D> psi = StateMatrix<D>::Identity();
      bool decorrelated = false;
      std::vector<ErrorTransition> transitions;
      for (NodeIndex i = query; i >= 0; --i) {
        if (i < count) call(i, psi);
        if (decorrelated || i == 0) continue;
        const std::size_t at = static_cast<std::size_t>(i) % NodeBlock::kSize;
        if (i == query || at + 1 == NodeBlock::kSize) {
          graph.ReadTransitions(static_cast<std::size_t>(i) / NodeBlock::kSize,
                                &transitions);
        }
        psi *= ToMatrix<D>(transitions[at]);
        if (psi.template lpNorm<Eigen::Infinity>() < kDecorrelatedNorm) {
          psi.setZero();
          decorrelated = true;
        }
      }
      return;
    }
  }
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CORRELATION_H_
