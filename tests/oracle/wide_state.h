// States, covariances and cross-covariances in long double, spelled out from
// the definitions of pose.h and core/noise and not taken from their code.
#ifndef REVISIT_TESTS_ORACLE_WIDE_STATE_H_
#define REVISIT_TESTS_ORACLE_WIDE_STATE_H_

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <optional>

#include "core/drive/confirmed_loop.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"

namespace revisit::oracle {

using Wide = long double;
using WideMatrix = Eigen::Matrix<Wide, Eigen::Dynamic, Eigen::Dynamic>;
using WideVector = Eigen::Matrix<Wide, Eigen::Dynamic, 1>;

inline constexpr Wide kWidePi = 3.14159265358979323846264338327950288L;

// The representative of an angle that is nearest to another.
inline Wide NearestTo(Wide centre, Wide angle) {
  return angle -
         2.0L * kWidePi * std::round((angle - centre) / (2.0L * kWidePi));
}

// (x, y, heading) or (x, y, z, heading).
inline WideVector WideStateOf(const core::Pose& pose, int dimensions) {
  WideVector state(dimensions);
  state(0) = pose.x;
  state(1) = pose.y;
  if (dimensions == 4) state(2) = pose.z;
  state(dimensions - 1) = pose.heading;
  return state;
}

inline int Coordinate(int i, int dimensions) {
  return i == dimensions - 1 ? 3 : i;
}

inline WideMatrix WideCovarianceOf(const core::Covariance& covariance,
                                   int dimensions) {
  WideMatrix wide(dimensions, dimensions);
  for (int r = 0; r < dimensions; ++r) {
    for (int c = 0; c < dimensions; ++c) {
      wide(r, c) =
          covariance(Coordinate(r, dimensions), Coordinate(c, dimensions));
    }
  }
  return wide;
}

inline WideMatrix WideTransitionOf(const core::ErrorTransition& transition,
                                   int dimensions) {
  WideMatrix wide(dimensions, dimensions);
  for (int r = 0; r < dimensions; ++r) {
    for (int c = 0; c < dimensions; ++c) {
      wide(r, c) = transition.values[static_cast<std::size_t>(
          4 * Coordinate(r, dimensions) + Coordinate(c, dimensions))];
    }
  }
  return wide;
}

// The turn by an angle about z.
inline WideMatrix WideTurn(Wide angle, int dimensions) {
  WideMatrix turn = WideMatrix::Identity(dimensions, dimensions);
  turn(0, 0) = turn(1, 1) = std::cos(angle);
  turn(1, 0) = std::sin(angle);
  turn(0, 1) = -turn(1, 0);
  return turn;
}

// The lever arm of a step by (x, y): a turn of what lies before it swings it.
inline WideMatrix WideLever(Wide x, Wide y, int dimensions) {
  WideMatrix lever = WideMatrix::Identity(dimensions, dimensions);
  lever(0, dimensions - 1) = -y;
  lever(1, dimensions - 1) = x;
  return lever;
}

inline WideMatrix WideDiagonal(Wide position, Wide heading, int dimensions) {
  WideMatrix diagonal = WideMatrix::Zero(dimensions, dimensions);
  for (int i = 0; i + 1 < dimensions; ++i) diagonal(i, i) = position * position;
  diagonal(dimensions - 1, dimensions - 1) = heading * heading;
  return diagonal;
}

// The error at node i, as one step of the model makes it of that at i - 1.
inline WideMatrix StepTransition(const core::PoseGraph& graph,
                                 const core::Correlation& correlation,
                                 core::NodeIndex i, int dimensions) {
  switch (correlation.model) {
    case core::CorrelationModel::kDeadReckoning: {
      const core::Pose& a = graph.node(i - 1).pose;
      const core::Pose& b = graph.node(i).pose;
      return WideLever(static_cast<Wide>(b.x) - a.x,
                       static_cast<Wide>(b.y) - a.y, dimensions);
    }
    case core::CorrelationModel::kIndependent:
      return WideMatrix::Zero(dimensions, dimensions);
    case core::CorrelationModel::kFilter:
    case core::CorrelationModel::kCorrelatedFixes:
      break;
  }
  return WideTransitionOf(graph.transition(i), dimensions);
}

// The covariance that two fixes of these covariances share with their mean.
inline Wide WideShared(const WideMatrix& a, const WideMatrix& b, Wide meters,
                       const core::Correlation& correlation) {
  const auto ratio_of_means = [](Wide x, Wide y) {
    return std::sqrt(x * y) / (0.5L * (x + y));
  };
  const auto last = a.rows() - 1;
  const Wide of_position = ratio_of_means(a.topLeftCorner(2, 2).trace(),
                                          b.topLeftCorner(2, 2).trace());
  return std::min(of_position, ratio_of_means(a(last, last), b(last, last))) *
         std::exp(-meters / correlation.meters);
}

// Cov(e_i, e_j): carried from the earlier node to the later step by step.
inline WideMatrix WideCross(const core::PoseGraph& graph,
                            const core::Correlation& correlation,
                            core::NodeIndex i, core::NodeIndex j,
                            int dimensions) {
  if (correlation.model == core::CorrelationModel::kCorrelatedFixes) {
    const WideMatrix a = WideCovarianceOf(graph.node(i).covariance, dimensions);
    const WideMatrix b = WideCovarianceOf(graph.node(j).covariance, dimensions);
    const Wide meters =
        std::abs(static_cast<Wide>(graph.node(i).travelled_meters) -
                 graph.node(j).travelled_meters);
    return 0.5L * WideShared(a, b, meters, correlation) * (a + b);
  }
  const core::NodeIndex earlier = std::min(i, j);
  WideMatrix carried =
      WideCovarianceOf(graph.node(earlier).covariance, dimensions);
  for (core::NodeIndex k = earlier + 1; k <= std::max(i, j); ++k) {
    carried =
        (StepTransition(graph, correlation, k, dimensions) * carried).eval();
  }
  if (i == earlier) carried.transposeInPlace();
  return carried;
}

inline WideMatrix WideGamma(const core::PoseGraph& graph,
                            const core::Correlation& correlation,
                            core::NodeIndex i, core::NodeIndex j,
                            int dimensions) {
  const WideMatrix cross = WideCross(graph, correlation, i, j, dimensions);
  return WideCovarianceOf(graph.node(i).covariance, dimensions) +
         WideCovarianceOf(graph.node(j).covariance, dimensions) - cross -
         cross.transpose();
}

// The error that a closure shows: y = e_c - lever e_m, up to the tolerance.
struct WideClosure {
  WideVector y;
  WideMatrix lever;
  WideMatrix tolerance;
};

// The closure of a measurement: the query pose less where the measurement puts
// it from the matched one, whose heading error swings it.
inline WideClosure WideMeasured(const core::MeasuredLoop& loop,
                                int dimensions) {
  const core::Pose& from = loop.matched.pose;
  const WideMatrix turn = WideTurn(from.heading, dimensions);
  const WideVector step =
      turn * WideStateOf(loop.measurement.relative, dimensions);
  WideClosure closure;
  closure.y = WideStateOf(loop.query.pose, dimensions) -
              WideStateOf(from, dimensions) - step;
  closure.y(dimensions - 1) = NearestTo(0.0L, closure.y(dimensions - 1));
  closure.lever = WideLever(step(0), step(1), dimensions);
  closure.tolerance =
      turn * WideCovarianceOf(loop.measurement.covariance, dimensions) *
      turn.transpose();
  return closure;
}

struct WideQuadraticForm {
  Wide squared = 0.0L;
  Wide log_determinant = 0.0L;
};

// Nothing where the matrix is not positive definite.
inline std::optional<WideQuadraticForm> EvaluateWide(const WideMatrix& gamma,
                                                     const WideVector& d) {
  const Eigen::LLT<WideMatrix> factor(gamma);
  if (factor.info() != Eigen::Success) return std::nullopt;
  WideQuadraticForm form;
  form.squared = d.dot(factor.solve(d));
  const WideMatrix lower = factor.matrixL();
  for (int i = 0; i < gamma.rows(); ++i) {
    form.log_determinant += 2.0L * std::log(lower(i, i));
  }
  return form;
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_WIDE_STATE_H_
