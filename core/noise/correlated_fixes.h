// Correlated fixes: fixes that depend on each other, since reflections or a
// smoother behind them change slowly. Their errors are a first-order
// Gauss-Markov process over the travelled distance s:
//
//   Gamma_ij = (1 - r) (S_ii + S_jj),   r = g exp(-|s_j - s_i| / L),
//
// with L the distance over which errors decorrelate. g <= 1 is the ratio of the
// geometric to the arithmetic mean of the two poses' variances, of the position
// in the plane or of the heading, whichever is less: where one covariance is a
// multiple of the other, Gamma is that of the process exactly. It is positive
// definite for any two poses, and tends to that of independent errors. The
// process: Gelb, "Applied Optimal Estimation" (1974), 3.6.
#ifndef REVISIT_CORE_NOISE_CORRELATED_FIXES_H_
#define REVISIT_CORE_NOISE_CORRELATED_FIXES_H_

#include <algorithm>
#include <cmath>

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// exp(-kDecayedAway) is nothing beside 1 in double precision.
inline constexpr double kDecayedAway = 37.0;

// The variances by which two fixes are alike: of the position in the plane, as
// a sum, and of the heading.
struct FixVariances {
  double position = 0.0;
  double heading = 0.0;
};

inline FixVariances FixVariancesOf(const Covariance& covariance) {
  return {covariance(0, 0) + covariance(1, 1), covariance(3, 3)};
}

// The ratio of the geometric to the arithmetic mean.
inline double RatioOfMeans(double a, double b) {
  return 2.0 * std::sqrt(a / (a + b)) * std::sqrt(b / (a + b));
}

// 1 - r for two fixes so far apart along the path: the share of S_ii + S_jj
// that is left in their difference. `meters` is L.
inline double UncorrelatedShare(const FixVariances& a, const FixVariances& b,
                                double meters_apart, double meters) {
  const double decayed = meters_apart / meters;
  if (!(decayed < kDecayedAway)) return 1.0;
  const double alike = std::min({1.0, RatioOfMeans(a.position, b.position),
                                 RatioOfMeans(a.heading, b.heading)});
  // Without cancellation for neighbours, which nearly share their error.
  return (1.0 - alike) - alike * std::expm1(-decayed);
}

struct CorrelatedFixes {
  static constexpr NoiseModel Row() {
    NoiseModel row;
    row.form = DifferenceForm::kSummed;
    row.decorrelates_over_way = true;
    row.claimed_growth = ClaimedGrowth::kDoesNotGrow;
    row.fixes_place = true;
    return row;
  }

  template <int D>
  static StateMatrix<D> Difference(const PathPair<D>& pair, double meters) {
    return Share(pair, meters) * (pair.earlier + pair.later);
  }

  template <int D>
  static StateMatrix<D> Cross(const PathPair<D>& pair, double meters) {
    const double r = 1.0 - Share(pair, meters);
    return 0.5 * r * (pair.earlier + pair.later);
  }

  // The covariance of the difference of the two positions, by which fixes
  // wander off: no earlier heading swings them. Beside it the variance of the
  // heading, which counts for each pose by itself, since a heading that is off
  // for a while must not bend the road.
  template <int D>
  static StateMatrix<D> OfStep(const PathPair<D>& step, double meters) {
    StateMatrix<D> noise = Difference(step, meters);
    noise.row(D - 1).setZero();
    noise.col(D - 1).setZero();
    noise(D - 1, D - 1) = step.later(D - 1, D - 1);
    return noise;
  }

  template <int D>
  static StepNoise<D> Split(const StateMatrix<D>& mean) {
    StepNoise<D> noise;
    noise.drift = mean;
    noise.drift(D - 1, D - 1) = 0.0;
    noise.jitter(D - 1, D - 1) = mean(D - 1, D - 1);
    return noise;
  }

 private:
  template <int D>
  static double Share(const PathPair<D>& pair, double meters) {
    const auto variances = [](const StateMatrix<D>& s) {
      return FixVariances{s(0, 0) + s(1, 1), s(D - 1, D - 1)};
    };
    return UncorrelatedShare(variances(pair.earlier), variances(pair.later),
                             pair.meters_apart, meters);
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_CORRELATED_FIXES_H_
