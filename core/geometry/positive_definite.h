// Whether a matrix is positive definite, where that is plain to see.
#ifndef REVISIT_CORE_GEOMETRY_POSITIVE_DEFINITE_H_
#define REVISIT_CORE_GEOMETRY_POSITIVE_DEFINITE_H_

#include "core/geometry/state_matrix.h"

namespace revisit::core {

// Whether the symmetric matrix, of which the lower triangle is read, is so far
// from not being positive definite that no rounding could make it so: each
// coordinate, given those before it, keeps more than a hundredth of its
// variance. Takes no roots. False says nothing, and is the answer for NaN.
// REQUIRES: squares and products of the entries neither overflow nor vanish.
template <int D>
bool IsClearlyPositiveDefinite(const StateMatrix<D>& matrix) {
  constexpr double kLeastShare = 1e-2;
  // With the matrix L D L^T: the entries of L D, and the inverse pivots.
  double scaled[D][D];
  double inverse[D];
  for (int r = 0; r < D; ++r) {
    double pivot = matrix(r, r);
    for (int c = 0; c < r; ++c) {
      double entry = matrix(r, c);
      for (int k = 0; k < c; ++k) {
        entry -= scaled[r][k] * scaled[c][k] * inverse[k];
      }
      scaled[r][c] = entry;
      pivot -= entry * entry * inverse[c];
    }
    if (!(matrix(r, r) > 0.0 && pivot > kLeastShare * matrix(r, r))) {
      return false;
    }
    inverse[r] = 1.0 / pivot;
  }
  return true;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_POSITIVE_DEFINITE_H_
