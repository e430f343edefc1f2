#include "core/candidates/consistency.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

#include "core/candidates/chi_squared.h"
#include "core/candidates/gate.h"
#include "core/geometry/heading.h"
#include "core/graph/correlation.h"

namespace revisit::core {
namespace {

// Values of ln f, evenly from 0 to ln max.
constexpr std::size_t kGridSize = 61;

class InflationPosterior {
 public:
  explicit InflationPosterior(double max_inflation) {
    for (std::size_t i = 0; i < kGridSize; ++i) {
      log_f_[i] = std::log(max_inflation) * static_cast<double>(i) /
                  static_cast<double>(kGridSize - 1);
      const double deviations = log_f_[i] / kInflationPrior;
      log_density_[i] = -0.5 * deviations * deviations;
    }
  }

  // `likelihood` gives the log of it for f.
  template <typename Likelihood>
  void Update(const Likelihood& likelihood) {
    for (std::size_t i = 0; i < kGridSize; ++i) {
      log_density_[i] += likelihood(std::exp(log_f_[i]));
    }
  }

  // exp of the mean of ln f.
  double Mean() const {
    const double greatest =
        *std::max_element(log_density_.begin(), log_density_.end());
    double sum = 0.0;
    double weighted = 0.0;
    for (std::size_t i = 0; i < kGridSize; ++i) {
      const double density = std::exp(log_density_[i] - greatest);
      sum += density;
      weighted += density * log_f_[i];
    }
    return std::exp(weighted / sum);
  }

 private:
  std::array<double, kGridSize> log_f_;
  std::array<double, kGridSize> log_density_;
};

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
  // Where nothing can be said, the gate is taken to cut nothing off.
  return passes > 0.0 ? std::log(passes) : 0.0;
}

template <int D>
Consistency Estimate(const PoseGraph& graph, const ConsistencyOptions& options,
                     const std::vector<ConfirmedLoop>& confirmed) {
  const double threshold =
      Gate(options.similarity.state_space, options.gate_probability)
          .threshold();
  Consistency result;
  result.degrees_of_freedom = D;
  InflationPosterior posterior(options.max_inflation);
  result.inflation = posterior.Mean();
  double sum_of_squares = 0.0;
  for (const ConfirmedLoop& loop : confirmed) {
    const StateMatrix<D> gamma = DifferenceCovariance<D>(
        graph, options.similarity.correlation, loop.query, loop.matched);
    SimilarityModel model = options.similarity;
    const auto covariance = [&](double f) {
      model.inflation = f;
      return ToleratedCovariance<D>(model, gamma);
    };
    const Pose& query = graph.node(loop.query).pose;
    const Pose& matched = graph.node(loop.matched).pose;
    // The gate has told the directions apart, and so do the headings.
    model.direction = std::abs(Difference(query, matched).heading) > 0.5 * kPi
                          ? Direction::kOpposite
                          : Direction::kSame;
    const StateVector<D> d = ToVector<D>(PassDifference(model, query, matched));
    const auto claimed = Evaluate<D>(covariance(1.0), d);
    if (!claimed) continue;
    ++result.confirmed;
    sum_of_squares += claimed->squared_mahalanobis;

    const StateMatrix<D> gated =
        covariance(options.applied ? result.inflation : 1.0);
    const auto in_force = Evaluate<D>(gated, d);
    const bool cut_off = in_force && in_force->squared_mahalanobis <= threshold;
    posterior.Update([&](double f) {
      const StateMatrix<D> spread = covariance(f);
      const auto terms = Evaluate<D>(spread, d);
      if (!terms) return 0.0;
      double likelihood =
          -0.5 * (terms->squared_mahalanobis + terms->log_determinant);
      if (cut_off) {
        likelihood -= LogPassProbability<D>(spread, gated, threshold);
      }
      return likelihood;
    });
    result.inflation = posterior.Mean();
  }
  if (result.confirmed > 0) {
    result.mean_normalized_innovation_squared =
        sum_of_squares / static_cast<double>(result.confirmed);
  }
  return result;
}

}  // namespace

Consistency EstimateConsistency(const PoseGraph& graph,
                                const ConsistencyOptions& options,
                                const std::vector<ConfirmedLoop>& confirmed) {
  return options.similarity.state_space == StateSpace::kPlanar
             ? Estimate<3>(graph, options, confirmed)
             : Estimate<4>(graph, options, confirmed);
}

}  // namespace revisit::core
