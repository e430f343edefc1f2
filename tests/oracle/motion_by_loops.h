// What motion_statistics.h says of a vehicle's steps and turns, by loops over
// all of them.
#ifndef REVISIT_TESTS_ORACLE_MOTION_BY_LOOPS_H_
#define REVISIT_TESTS_ORACLE_MOTION_BY_LOOPS_H_

#include <Eigen/Eigenvalues>
#include <cmath>
#include <cstdint>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

struct MotionByLoops {
  std::int64_t steps = 0;
  WideMatrix drift;
  WideMatrix jitter;
  // The size of the largest term that went into a mean, which bounds how far
  // differences of such terms can be trusted.
  Wide largest_term = 0.0L;
};

inline bool OneStep(const core::PoseGraph& graph, core::NodeIndex i) {
  return i > 0 && graph.SegmentStart(i) == graph.SegmentStart(i - 1);
}

// Eigenvalues below 0 made 0.
inline WideMatrix NearestSemidefinite(const WideMatrix& m) {
  const Eigen::SelfAdjointEigenSolver<WideMatrix> solver(
      WideMatrix(0.5L * (m + m.transpose())));
  WideMatrix kept = WideMatrix::Zero(m.rows(), m.cols());
  for (int k = 0; k < m.rows(); ++k) {
    if (solver.eigenvalues()(k) <= 0.0L) continue;
    const WideVector v = solver.eigenvectors().col(k);
    kept += solver.eigenvalues()(k) * v * v.transpose();
  }
  return kept;
}

// Cov(e_i - F e_(i-1)) where Cov(e_i, e_(i-1)) = Psi S_(i-1), averaged in the
// axes of the vehicle.
inline MotionByLoops MeasureByLoops(const core::PoseGraph& graph,
                                    const core::Correlation& correlation,
                                    core::NodeIndex last, int dimensions) {
  MotionByLoops result;
  result.drift = result.jitter = WideMatrix::Zero(dimensions, dimensions);
  for (core::NodeIndex i = 1; i <= last; ++i) {
    if (!OneStep(graph, i)) continue;
    ++result.steps;
    const WideMatrix turn = WideTurn(graph.node(i).pose.heading, dimensions);
    const WideMatrix s = WideCovarianceOf(graph.node(i).covariance, dimensions);
    if (correlation.model == core::CorrelationModel::kCorrelatedFixes) {
      const int heading = dimensions - 1;
      WideMatrix wandering =
          WideGamma(graph, correlation, i - 1, i, dimensions);
      wandering.row(heading).setZero();
      wandering.col(heading).setZero();
      result.drift += turn.transpose() * wandering * turn;
      result.jitter(heading, heading) += s(heading, heading);
      result.largest_term =
          std::max(result.largest_term, s.cwiseAbs().maxCoeff());
      continue;
    }
    if (correlation.model == core::CorrelationModel::kIndependent) {
      result.jitter += turn.transpose() * s * turn;
      result.largest_term =
          std::max(result.largest_term, s.cwiseAbs().maxCoeff());
      continue;
    }
    const WideMatrix before =
        WideCovarianceOf(graph.node(i - 1).covariance, dimensions);
    const WideMatrix f = StepTransition(
        graph, core::CorrelationModel::kDeadReckoning, i, dimensions);
    const WideMatrix cross =
        StepTransition(graph, correlation, i, dimensions) * before;
    const WideMatrix added = s + f * before * f.transpose() -
                             cross * f.transpose() - f * cross.transpose();
    result.drift += turn.transpose() * added * turn;
    result.largest_term =
        std::max({result.largest_term, s.cwiseAbs().maxCoeff(),
                  (f * before * f.transpose()).cwiseAbs().maxCoeff(),
                  (cross * f.transpose()).cwiseAbs().maxCoeff()});
  }
  if (result.steps > 0) {
    const auto count = static_cast<Wide>(result.steps);
    result.drift = NearestSemidefinite(result.drift / count);
    result.jitter = NearestSemidefinite(result.jitter / count);
  }
  return result;
}

// Share of all stretches that turn by `turn` to within the tolerance, with one
// more that does.
inline Wide ShareByLoops(const core::PoseGraph& graph, core::NodeIndex last,
                         core::NodeIndex stretch_nodes, double turn,
                         double tolerance_radians) {
  std::int64_t all = 1;
  std::int64_t alike = 1;
  for (core::NodeIndex a = 0; a + stretch_nodes <= last; ++a) {
    const core::NodeIndex b = a + stretch_nodes;
    if (graph.SegmentStart(a) != graph.SegmentStart(b)) continue;
    ++all;
    const Wide turned =
        NearestTo(0.0L, static_cast<Wide>(graph.node(b).pose.heading) -
                            graph.node(a).pose.heading);
    if (std::abs(turned - turn) <= tolerance_radians) ++alike;
  }
  return static_cast<Wide>(alike) / static_cast<Wide>(all);
}

// The bin of the turn from node a to node b: the nearest of 128 directions.
inline long BinOfTurn(double turn) {
  return std::lround(turn * 128.0 / (2.0 * static_cast<double>(kWidePi)));
}

// Share of the pairs of stretches whose later one turns about by `later`, whose
// earlier one turns about by `turn`: to the neighbouring bin. As many pairs are
// added as hold one by the share of all stretches, which is at most thousand.
inline Wide PairShareByLoops(const core::PoseGraph& graph, core::NodeIndex last,
                             core::NodeIndex stretch_nodes, double turn,
                             double later, Wide share) {
  const auto alike = [](double a, double b) {
    const long apart = std::labs(BinOfTurn(a) - BinOfTurn(b)) % 128;
    return std::min(apart, 128 - apart) <= 1;
  };
  const auto turned = [&graph](core::NodeIndex a, core::NodeIndex b) {
    return core::WrapHeading(graph.node(b).pose.heading -
                             graph.node(a).pose.heading);
  };
  std::int64_t with_later = 0;
  std::int64_t both = 0;
  for (core::NodeIndex a = 0; a + 2 * stretch_nodes <= last; ++a) {
    const core::NodeIndex b = a + stretch_nodes;
    const core::NodeIndex c = b + stretch_nodes;
    if (graph.SegmentStart(a) != graph.SegmentStart(c)) continue;
    if (!alike(turned(b, c), later)) continue;
    ++with_later;
    if (alike(turned(a, b), turn)) ++both;
  }
  return (1.0L + static_cast<Wide>(both)) /
         (1.0L / std::max(1e-3L, share) + static_cast<Wide>(with_later));
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_MOTION_BY_LOOPS_H_
