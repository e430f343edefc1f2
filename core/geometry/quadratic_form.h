// The terms of a Gaussian density.
#ifndef REVISIT_CORE_GEOMETRY_QUADRATIC_FORM_H_
#define REVISIT_CORE_GEOMETRY_QUADRATIC_FORM_H_

#include <optional>

#include "core/geometry/state_matrix.h"

namespace revisit::core {

// The terms of a Gaussian in d with covariance gamma.
struct QuadraticForm {
  double squared_mahalanobis = 0.0;  // d^T gamma^-1 d
  double log_determinant = 0.0;      // ln|gamma|
};

// Computed by LDL^T. Nothing if a pivot is not above kPivotTolerance times its
// diagonal entry: as far as double precision shows, gamma is not positive
// definite then.
template <int D>
std::optional<QuadraticForm> Evaluate(const StateMatrix<D>& gamma,
                                      const StateVector<D>& d);

// Whether Evaluate() takes the matrix for positive definite.
template <int D>
bool IsPositiveDefinite(const StateMatrix<D>& matrix) {
  return Evaluate<D>(matrix, StateVector<D>::Zero()).has_value();
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_QUADRATIC_FORM_H_
