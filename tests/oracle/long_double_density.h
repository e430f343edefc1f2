// Eq. 2 and 3 of the paper, spelled out in long double: the determinant by
// cofactors, the inverse by the adjugate.
#ifndef REVISIT_TESTS_ORACLE_LONG_DOUBLE_DENSITY_H_
#define REVISIT_TESTS_ORACLE_LONG_DOUBLE_DENSITY_H_

#include <cmath>
#include <vector>

namespace revisit::oracle {

using Matrix = std::vector<std::vector<long double>>;

inline Matrix Minor(const Matrix& m, std::size_t row, std::size_t column) {
  Matrix minor;
  for (std::size_t r = 0; r < m.size(); ++r) {
    if (r == row) continue;
    std::vector<long double> entries;
    for (std::size_t c = 0; c < m.size(); ++c) {
      if (c != column) entries.push_back(m[r][c]);
    }
    minor.push_back(entries);
  }
  return minor;
}

inline long double Determinant(const Matrix& m) {
  if (m.size() == 1) return m[0][0];
  long double sum = 0;
  for (std::size_t c = 0; c < m.size(); ++c) {
    const long double sign = c % 2 == 0 ? 1 : -1;
    sum += sign * m[0][c] * Determinant(Minor(m, 0, c));
  }
  return sum;
}

inline long double SquaredMahalanobis(const Matrix& gamma,
                                      const std::vector<long double>& d) {
  long double sum = 0;
  for (std::size_t r = 0; r < d.size(); ++r) {
    for (std::size_t c = 0; c < d.size(); ++c) {
      const long double sign = (r + c) % 2 == 0 ? 1 : -1;
      const long double cofactor =
          d.size() == 1 ? 1 : sign * Determinant(Minor(gamma, r, c));
      sum += d[r] * cofactor * d[c];
    }
  }
  return sum / Determinant(gamma);
}

// `half` of the exponent: 1/2 for the Gaussian, 1 as printed.
inline long double LogSimilarity(const Matrix& gamma,
                                 const std::vector<long double>& d,
                                 long double half) {
  return -0.5L * std::log(Determinant(gamma)) -
         half * SquaredMahalanobis(gamma, d);
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_LONG_DOUBLE_DENSITY_H_
