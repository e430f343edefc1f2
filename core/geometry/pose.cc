#include "core/geometry/pose.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/number_text.h"
#include "core/geometry/heading.h"
#include "core/geometry/positive_definite.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {
namespace {

Defect OutOfRange(const char* part, const std::string& what, double value,
                  double limit) {
  return {DefectKind::kOutOfRange, part,
          what + " is " + NumberText(value) + "; allowed is [-" +
              NumberText(limit) + ", " + NumberText(limit) + "]"};
}

Defect NotFinite(const char* part, const std::string& what) {
  return {DefectKind::kNotFinite, part, what + " is not a finite number"};
}

// Name of coordinate i of the state, for messages.
template <int D>
const char* CoordinateName(int i) {
  static constexpr const char* kNames[] = {"x", "y", "z", "heading"};
  return kNames[StateIndex<D>(i)];
}

template <int D>
std::optional<Defect> FindCovarianceDefect(const Covariance& covariance) {
  for (int r = 0; r < D; ++r) {
    for (int c = r; c < D; ++c) {
      if (!std::isfinite(covariance(StateIndex<D>(r), StateIndex<D>(c)))) {
        return NotFinite("covariance", std::string("the entry of ") +
                                           CoordinateName<D>(r) + " and " +
                                           CoordinateName<D>(c));
      }
    }
  }
  std::array<double, D> deviation;
  for (int i = 0; i < D; ++i) {
    const double variance = covariance(StateIndex<D>(i), StateIndex<D>(i));
    if (!(variance > 0.0)) {
      return Defect{DefectKind::kNotPositiveDefinite, "covariance",
                    std::string("the variance of ") + CoordinateName<D>(i) +
                        " is " + NumberText(variance) +
                        "; a positive definite covariance needs it above 0"};
    }
    deviation[i] = std::sqrt(variance);
    if (deviation[i] > kMaxStandardDeviation) {
      return Defect{DefectKind::kOutOfRange, "covariance",
                    std::string("the standard deviation of ") +
                        CoordinateName<D>(i) + " is " +
                        NumberText(deviation[i]) + "; allowed is at most " +
                        NumberText(kMaxStandardDeviation)};
    }
  }
  // Cholesky factor of the correlation matrix, whose pivots have no units and
  // are at most 1.
  StateMatrix<D> factor = StateMatrix<D>::Zero();
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < r; ++c) {
      double sum = covariance(StateIndex<D>(r), StateIndex<D>(c)) /
                   (deviation[r] * deviation[c]);
      for (int k = 0; k < c; ++k) sum -= factor(r, k) * factor(c, k);
      factor(r, c) = sum / factor(c, c);
    }
    double pivot = 1.0;
    for (int k = 0; k < r; ++k) pivot -= factor(r, k) * factor(r, k);
    if (!(pivot > kPivotTolerance)) {
      return Defect{
          DefectKind::kNotPositiveDefinite, "covariance",
          std::string("it is not positive definite: given the coordinates "
                      "before it, ") +
              CoordinateName<D>(r) + " keeps " + NumberText(pivot) +
              " of its variance; allowed is above " +
              NumberText(kPivotTolerance)};
    }
    factor(r, r) = std::sqrt(pivot);
  }
  return std::nullopt;
}

// Whether a covariance is so far from having a defect that no rounding could
// make it one. False says nothing.
template <int D>
bool IsClearlySound(const Covariance& covariance) {
  constexpr double kLeastVariance = 1e-60;
  constexpr double kMostVariance =
      0.99 * kMaxStandardDeviation * kMaxStandardDeviation;
  for (int i = 0; i < D; ++i) {
    const double variance = covariance(StateIndex<D>(i), StateIndex<D>(i));
    if (!(variance > kLeastVariance && variance < kMostVariance)) return false;
  }
  return IsClearlyPositiveDefinite<D>(ToMatrix<D>(covariance));
}

template <int D>
bool IsSound(const Covariance& covariance) {
  return IsClearlySound<D>(covariance) || !FindCovarianceDefect<D>(covariance);
}

template <int D>
std::optional<Defect> FindTransitionDefect(const ErrorTransition& transition) {
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      const double value = transition.values[static_cast<std::size_t>(
          4 * StateIndex<D>(r) + StateIndex<D>(c))];
      if (std::abs(value) <= kMaxTransitionEntry) continue;  // False for NaN.
      const std::string what = std::string("the entry of ") +
                               CoordinateName<D>(r) + " from " +
                               CoordinateName<D>(c);
      if (!std::isfinite(value)) return NotFinite("error_transition", what);
      return OutOfRange("error_transition", what, value, kMaxTransitionEntry);
    }
  }
  return std::nullopt;
}

}  // namespace

Pose Difference(const Pose& a, const Pose& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z, WrapHeading(a.heading - b.heading)};
}

double Distance(const Pose& a, const Pose& b, StateSpace space) {
  const double z = space == StateSpace::kPlanar ? 0.0 : a.z - b.z;
  return std::hypot(a.x - b.x, a.y - b.y, z);
}

std::optional<Defect> FindDefect(const PoseSample& sample, StateSpace space) {
  const std::pair<const char*, double> position[] = {
      {"x", sample.pose.x}, {"y", sample.pose.y}, {"z", sample.pose.z}};
  for (const auto& [name, value] : position) {
    if (!std::isfinite(value)) return NotFinite("position", name);
    if (std::abs(value) > kMaxCoordinateMeters) {
      return OutOfRange("position", name, value, kMaxCoordinateMeters);
    }
  }
  if (!std::isfinite(sample.pose.heading)) {
    return NotFinite("heading", "heading");
  }
  if (std::abs(sample.pose.heading) > kMaxHeadingRadians) {
    return OutOfRange("heading", "heading", sample.pose.heading,
                      kMaxHeadingRadians);
  }
  const bool planar = space == StateSpace::kPlanar;
  if (auto defect = planar ? FindCovarianceDefect<3>(sample.covariance)
                           : FindCovarianceDefect<4>(sample.covariance)) {
    return defect;
  }
  if (!sample.transition) return std::nullopt;
  return planar ? FindTransitionDefect<3>(*sample.transition)
                : FindTransitionDefect<4>(*sample.transition);
}

bool IsSound(const Covariance& covariance, StateSpace space) {
  return space == StateSpace::kPlanar ? IsSound<3>(covariance)
                                      : IsSound<4>(covariance);
}

std::optional<Defect> FindAsymmetry(const double* matrix, int size) {
  double largest = 0.0;
  for (int i = 0; i < size * size; ++i) {
    if (!std::isfinite(matrix[i])) {
      return NotFinite("covariance", absl::StrCat("entry ", i));
    }
    largest = std::max(largest, std::abs(matrix[i]));
  }
  for (int r = 0; r < size; ++r) {
    for (int c = r + 1; c < size; ++c) {
      const double upper = matrix[r * size + c];
      const double lower = matrix[c * size + r];
      if (std::abs(upper - lower) > kSymmetryTolerance * largest) {
        return Defect{
            DefectKind::kNotSymmetric, "covariance",
            absl::StrCat("row ", r, " column ", c, " is ", NumberText(upper),
                         " but its mirror image is ", NumberText(lower),
                         "; allowed is a difference of at most ",
                         NumberText(kSymmetryTolerance * largest))};
      }
    }
  }
  return std::nullopt;
}

}  // namespace revisit::core
