#include "core/geometry/quadratic_form.h"

#include <cmath>

#include "core/geometry/pose.h"

namespace revisit::core {

template <int D>
std::optional<QuadraticForm> Evaluate(const StateMatrix<D>& gamma,
                                      const StateVector<D>& d) {
  // gamma = L diag(pivot) L^T, L unit lower triangular; solved = L^-1 d.
  double lower[D][D];
  double scaled[D][D];  // L(r,c) * pivot(c)
  double pivot[D];
  double inverse[D];
  double solved[D];
  QuadraticForm terms;
  double determinant = 1.0;
  for (int r = 0; r < D; ++r) {
    double p = gamma(r, r);
    double y = d(r);
    for (int c = 0; c < r; ++c) {
      double s = gamma(r, c);
      for (int k = 0; k < c; ++k) s -= scaled[r][k] * lower[c][k];
      scaled[r][c] = s;
      lower[r][c] = s * inverse[c];
      p -= lower[r][c] * s;
      y -= lower[r][c] * solved[c];
    }
    // Written so that NaN fails too.
    if (!(p > kPivotTolerance * gamma(r, r)) || !std::isfinite(p)) {
      return std::nullopt;
    }
    pivot[r] = p;
    inverse[r] = 1.0 / p;
    solved[r] = y;
    determinant *= p;
    terms.squared_mahalanobis += y * y * inverse[r];
  }
  // Pivots of a valid graph lie within (1e-60, 1e40), so that their product is
  // finite and takes a single logarithm. Beyond that, each takes its own.
  if (std::isnormal(determinant)) {
    terms.log_determinant = std::log(determinant);
  } else {
    for (int r = 0; r < D; ++r) terms.log_determinant += std::log(pivot[r]);
  }
  if (!std::isfinite(terms.squared_mahalanobis)) return std::nullopt;
  return terms;
}

template std::optional<QuadraticForm> Evaluate<3>(const StateMatrix<3>&,
                                                  const StateVector<3>&);
template std::optional<QuadraticForm> Evaluate<4>(const StateMatrix<4>&,
                                                  const StateVector<4>&);

}  // namespace revisit::core
