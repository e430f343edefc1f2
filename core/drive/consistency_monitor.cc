#include "core/drive/consistency_monitor.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"

namespace revisit::core {
namespace {

// Number of values of ln f, spread evenly from 0 to ln max.
constexpr std::size_t kGridSize = 31;

double LogFactor(std::size_t i, double max_inflation) {
  return std::log(max_inflation) * static_cast<double>(i) /
         static_cast<double>(kGridSize - 1);
}

// ln of the prior's density at each ln f, up to a constant.
std::vector<double> LogPriorDensity(double max_inflation) {
  std::vector<double> log_density(kGridSize);
  for (std::size_t i = 0; i < kGridSize; ++i) {
    const double deviations = LogFactor(i, max_inflation) / kInflationPrior;
    log_density[i] = -0.5 * deviations * deviations;
  }
  return log_density;
}

// exp of the mean of ln f, by the trapezoid rule.
double MeanInflation(const std::vector<double>& log_density,
                     double max_inflation) {
  const double greatest =
      *std::max_element(log_density.begin(), log_density.end());
  double sum = 0.0;
  double weighted = 0.0;
  for (std::size_t i = 0; i < kGridSize; ++i) {
    const bool is_end = i == 0 || i + 1 == kGridSize;
    const double mass =
        (is_end ? 0.5 : 1.0) * std::exp(log_density[i] - greatest);
    sum += mass;
    weighted += mass * LogFactor(i, max_inflation);
  }
  return std::exp(weighted / sum);
}

// ln P(d^T b^-1 d <= threshold) for d ~ N(0, a).
template <int D>
double LogPassProbability(const StateMatrix<D>& a, const StateMatrix<D>& b,
                          double threshold) {
  // The form is a sum of chi-squares weighted by the eigenvalues of b^-1 a.
  const StateMatrix<D> m = Eigen::LDLT<StateMatrix<D>>(b).solve(a);
  const double sum = m.trace();
  const double sum_of_squares = (m * m).trace();
  const double scale = sum_of_squares / sum;
  const double degrees = sum * sum / sum_of_squares;
  const double passes = ChiSquaredBelow(degrees, threshold / scale);
  // Where the approximation fails, the gate counts as cutting nothing off.
  return passes > 0.0 ? std::log(passes) : 0.0;
}

// The error that a closure shows: the difference of its nodes, or the
// innovation of its measurement.
template <int D>
struct Shown {
  StateVector<D> difference;
  StateMatrix<D> gamma;
  // The measurement's covariance, or nothing for the tolerance.
  std::optional<StateMatrix<D>> measurement;

  // With standard deviations f times as claimed.
  std::optional<QuadraticForm> Under(SimilarityModel model, double f) const {
    model.inflation = f;
    return Evaluate<D>(measurement
                           ? StateMatrix<D>((f * f) * gamma + *measurement)
                           : ToleratedCovariance<D>(model, gamma),
                       difference);
  }
};

}  // namespace

ConsistencyMonitor::ConsistencyMonitor(const ConsistencyOptions& options)
    : options_(options),
      threshold_(
          ChiSquaredQuantile(DegreesOfFreedom(options.similarity.state_space),
                             options.gate_probability)) {
  consistency_.degrees_of_freedom =
      DegreesOfFreedom(options.similarity.state_space);
  consistency_.inflation = MeanInflation(LogPriorDensity(options.max_inflation),
                                         options.max_inflation);
}

void ConsistencyMonitor::Confirm(const PoseGraph& graph,
                                 const ConfirmedLoop& loop) {
  if (options_.similarity.state_space == StateSpace::kPlanar) {
    Confirm<3>(graph, loop);
  } else {
    Confirm<4>(graph, loop);
  }
}

template <int D>
void ConsistencyMonitor::Confirm(const PoseGraph& graph,
                                 const ConfirmedLoop& loop) {
  const StateMatrix<D> gamma = DifferenceCovariance<D>(
      graph, options_.similarity.correlation, loop.query, loop.matched);
  SimilarityModel model = options_.similarity;
  const auto covariance = [&](double f) {
    model.inflation = f;
    return ToleratedCovariance<D>(model, gamma);
  };
  const Pose query = graph.pose(loop.query);
  const Pose matched = graph.pose(loop.matched);
  model.direction = DirectionOf(graph, loop);
  const StateVector<D> d = ToVector<D>(PassDifference(model, query, matched));
  Shown<D> shown{d, gamma, std::nullopt};
  if (loop.measured) {
    const Innovation<D> innovation =
        InnovationOf<D>(graph, model.correlation, loop);
    shown = {innovation.difference, innovation.gamma,
             MeasurementCovariance<D>(*loop.measured)};
  }
  const std::optional<QuadraticForm> claimed = shown.Under(model, 1.0);
  if (!claimed) return;
  const StateMatrix<D> gated =
      covariance(options_.applied ? consistency_.inflation : 1.0);
  const std::optional<QuadraticForm> in_force = Evaluate<D>(gated, d);
  if (!in_force) return;
  const bool cut_off = in_force->squared_mahalanobis <= threshold_;
  std::array<double, kGridSize> log_likelihood;
  for (std::size_t i = 0; i < kGridSize; ++i) {
    const double f = std::exp(LogFactor(i, options_.max_inflation));
    const std::optional<QuadraticForm> terms = shown.Under(model, f);
    if (!terms) return;
    log_likelihood[i] =
        -0.5 * (terms->squared_mahalanobis + terms->log_determinant);
    if (cut_off) {
      log_likelihood[i] -=
          LogPassProbability<D>(covariance(f), gated, threshold_);
    }
  }

  ++consistency_.confirmed;
  sum_of_squares_ += claimed->squared_mahalanobis;
  consistency_.mean_normalized_innovation_squared =
      sum_of_squares_ / static_cast<double>(consistency_.confirmed);
  if (log_density_.empty()) {
    log_density_ = LogPriorDensity(options_.max_inflation);
  }
  for (std::size_t i = 0; i < kGridSize; ++i) {
    log_density_[i] += log_likelihood[i];
  }
  consistency_.inflation = MeanInflation(log_density_, options_.max_inflation);
}

}  // namespace revisit::core
