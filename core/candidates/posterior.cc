#include "core/candidates/posterior.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

namespace revisit::core {

Posterior::Posterior(const PoseGraph& graph,
                     std::array<std::vector<double>, 2> log_odds)
    : graph_(graph), log_odds_(std::move(log_odds)) {
  double greatest = 0.0;
  for (const std::vector<double>& odds : log_odds_) {
    for (const double o : odds) greatest = std::max(greatest, o);
  }
  double sum = std::exp(-greatest);
  for (const std::vector<double>& odds : log_odds_) {
    for (const double o : odds) sum += std::exp(o - greatest);
  }
  log_total_ = greatest + std::log(sum);
}

double Posterior::Claim(Direction direction, NodeIndex j) {
  std::vector<double>& odds = log_odds_[IndexOf(direction)];
  const auto size = static_cast<NodeIndex>(odds.size());
  const auto near = [&](NodeIndex i) {
    return graph_.MetersApart(i, j) <= kPlaceRadiusMeters;
  };
  double sum = 0.0;
  const auto claim = [&](NodeIndex i) {
    sum += Probability(
        std::exchange(odds[static_cast<std::size_t>(i)], kImpossible));
  };
  for (NodeIndex i = j; i >= 0 && near(i); --i) claim(i);
  for (NodeIndex i = j + 1; i < size && near(i); ++i) claim(i);
  return std::min(sum, 1.0);
}

double Posterior::Probability(double log_odds) const {
  return std::exp(log_odds - log_total_);
}

}  // namespace revisit::core
