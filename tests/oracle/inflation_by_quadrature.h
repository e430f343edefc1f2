// The posterior of consistency.h, with the probability that a pair passes the
// gate found by integration over all pairs.
#ifndef REVISIT_TESTS_ORACLE_INFLATION_BY_QUADRATURE_H_
#define REVISIT_TESTS_ORACLE_INFLATION_BY_QUADRATURE_H_

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <boost/math/distributions/chi_squared.hpp>
#include <cmath>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/consistency_monitor.h"
#include "core/drive/pose_graph.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

// P(sum over i >= first of weights(i) z_i^2 <= limit), z standard normal. One
// coordinate is integrated out at a time: z = sqrt(limit / weight) sin(angle)
// leaves limit cos^2(angle) for the others.
inline double WeightedSquaresBelow(const std::vector<double>& weights,
                                   std::size_t first, double limit) {
  const double radius = std::sqrt(limit / weights[first]);
  if (first + 1 == weights.size()) return std::erf(radius / std::sqrt(2.0));
  // A factor of the integrand is no wider than 10 standard deviations.
  const double widest = std::asin(std::min(1.0, 10.0 / radius));
  const int cells = 24;
  double sum = 0.0;
  for (int k = 0; k < cells; ++k) {
    const double angle = widest * (k + 0.5) / cells;
    const double z = radius * std::sin(angle);
    const double rest = std::cos(angle);
    sum += std::exp(-0.5 * z * z) * radius * rest *
           WeightedSquaresBelow(weights, first + 1, limit * rest * rest);
  }
  // Both signs of z.
  return 2.0 * sum * widest / cells / std::sqrt(2.0 * 3.14159265358979);
}

// With the gate that the claimed covariances make: the inflation not applied.
inline double InflationByQuadrature(
    const core::PoseGraph& graph, const core::ConsistencyOptions& options,
    const std::vector<core::ConfirmedLoop>& confirmed) {
  const int d =
      options.similarity.state_space == core::StateSpace::kPlanar ? 3 : 4;
  const double threshold = boost::math::quantile(boost::math::chi_squared(d),
                                                 options.gate_probability);
  const WideMatrix tolerance =
      WideDiagonal(options.similarity.tolerance.position_meters,
                   options.similarity.tolerance.heading_radians, d);
  const int values = 101;
  std::vector<Wide> log_f;
  std::vector<Wide> log_density;
  for (int v = 0; v < values; ++v) {
    log_f.push_back(std::log(static_cast<Wide>(options.max_inflation)) * v /
                    (values - 1));
    const Wide deviations = log_f.back() / core::kInflationPrior;
    log_density.push_back(-0.5L * deviations * deviations);
  }
  for (const core::ConfirmedLoop& loop : confirmed) {
    const WideMatrix gamma = WideGamma(graph, options.similarity.correlation,
                                       loop.query, loop.matched, d);
    const Eigen::LLT<WideMatrix> gate(WideMatrix(gamma + tolerance));
    WideVector difference = WideStateOf(graph.node(loop.query).pose, d) -
                            WideStateOf(graph.node(loop.matched).pose, d);
    difference(d - 1) = NearestTo(0.0L, difference(d - 1));
    // A pass the other way is one whose headings differ by more than a right
    // angle.
    if (std::abs(difference(d - 1)) > 0.5L * kWidePi) {
      difference(d - 1) = NearestTo(0.0L, difference(d - 1) + kWidePi);
    }
    const bool passed = difference.dot(gate.solve(difference)) <= threshold;
    WideVector shown = difference;
    WideMatrix shown_gamma = gamma;
    WideMatrix shown_tolerance = tolerance;
    if (loop.measured) {
      const WideClosure closure = WideMeasured(*loop.measured, d);
      const WideMatrix mixed = WideCross(graph, options.similarity.correlation,
                                         loop.query, loop.matched, d) *
                               closure.lever.transpose();
      shown = closure.y;
      shown_gamma =
          WideCovarianceOf(graph.node(loop.query).covariance, d) +
          closure.lever *
              WideCovarianceOf(graph.node(loop.matched).covariance, d) *
              closure.lever.transpose() -
          mixed - mixed.transpose();
      shown_tolerance = closure.tolerance;
    }
    for (int v = 0; v < values; ++v) {
      const auto at = static_cast<std::size_t>(v);
      const WideMatrix spread = std::exp(2.0L * log_f[at]) * gamma + tolerance;
      const auto form = EvaluateWide(
          std::exp(2.0L * log_f[at]) * shown_gamma + shown_tolerance, shown);
      log_density[at] -= 0.5L * (form->squared + form->log_determinant);
      if (!passed) continue;
      // In the axes in which the gate is a ball.
      const WideMatrix half = gate.matrixL().solve(spread);
      const WideMatrix seen =
          gate.matrixL().solve(WideMatrix(half.transpose()));
      const WideVector eigenvalues =
          Eigen::SelfAdjointEigenSolver<WideMatrix>(seen).eigenvalues();
      const WideVector::ConstReverseReturnType descending =
          eigenvalues.reverse();
      std::vector<double> weights;
      for (int i = 0; i < d; ++i) {
        weights.push_back(static_cast<double>(descending(i)));
      }
      log_density[at] -= std::log(WeightedSquaresBelow(weights, 0, threshold));
    }
  }
  const Wide greatest =
      *std::max_element(log_density.begin(), log_density.end());
  Wide sum = 0.0L;
  Wide weighted = 0.0L;
  for (std::size_t v = 0; v < log_f.size(); ++v) {
    // By the trapezoid rule, whose ends count half.
    const bool is_end = v == 0 || v + 1 == log_f.size();
    const Wide mass =
        (is_end ? 0.5L : 1.0L) * std::exp(log_density[v] - greatest);
    sum += mass;
    weighted += mass * log_f[v];
  }
  return static_cast<double>(std::exp(weighted / sum));
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_INFLATION_BY_QUADRATURE_H_
