// Sums of what is kept as its logarithm.
#ifndef REVISIT_CORE_SEARCH_BELIEF_LOG_ODDS_H_
#define REVISIT_CORE_SEARCH_BELIEF_LOG_ODDS_H_

#include <algorithm>
#include <cmath>

#include "core/search/alignment/exponential_sum.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/belief/mark.h"

namespace revisit::core {

// ln(e^a + e^b), kImpossible if both are.
inline double LogAdd(double a, double b) {
  const double greater = std::max(a, b);
  if (greater == kImpossible) return greater;
  const double less = std::min(a, b) - greater;
  // It would add less than half of the last bit of a number that is not
  // small itself.
  if (less < -kNegligible && std::abs(greater) >= 1.0) return greater;
  return greater + std::log1p(std::exp(less));
}

// The logarithm of the sum over all scales. REQUIRES: one is not kImpossible.
inline double LogSum(const ByScale& terms) {
  const double greatest = *std::max_element(terms.begin(), terms.end());
  double sum = 0.0;
  for (const double term : terms) sum += std::exp(term - greatest);
  return greatest + std::log(sum);
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_LOG_ODDS_H_
