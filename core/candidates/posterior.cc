#include "core/candidates/posterior.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

namespace revisit::core {
namespace {

// A term that is smaller than a sum by this factor, as a logarithm, is less
// than half of the sum's last bit: 54 ln 2 is 37.4.
constexpr double kNegligible = 38.0;

}  // namespace

Posterior::Posterior(const PoseGraph& graph, std::array<ScoredEnds, 2> log_odds)
    : graph_(graph), log_odds_(std::move(log_odds)) {
  double greatest = 0.0;
  for (const ScoredEnds& ends : log_odds_) {
    for (const ScoredEnd& end : ends) greatest = std::max(greatest, end.score);
  }
  double sum = std::exp(-greatest);
  // Most terms are so small that the sum stays the same double.
  double largest = -greatest;
  for (const ScoredEnds& ends : log_odds_) {
    for (const ScoredEnd& end : ends) {
      const double term = end.score - greatest;
      if (term < largest - kNegligible) continue;
      largest = std::max(largest, term);
      sum += std::exp(term);
    }
  }
  log_total_ = greatest + std::log(sum);
}

double Posterior::Claim(Direction direction, NodeIndex j) {
  ScoredEnds& ends = log_odds_[IndexOf(direction)];
  const EndsAround around = FindEndsAround(ends, j, [&](NodeIndex i) {
    return graph_.MetersApart(i, j) <= kPlaceRadiusMeters;
  });
  double sum = 0.0;
  const auto claim = [&](std::size_t k) {
    sum += Probability(std::exchange(ends[k].score, kImpossible));
  };
  // From the place itself outward.
  for (std::size_t k = around.later; k > around.first; --k) claim(k - 1);
  for (std::size_t k = around.later; k < around.last; ++k) claim(k);
  return std::min(sum, 1.0);
}

double Posterior::Probability(double log_odds) const {
  return std::exp(log_odds - log_total_);
}

}  // namespace revisit::core
