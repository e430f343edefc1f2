#include "core/search/candidates/posterior.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

#include "core/search/alignment/exponential_sum.h"

namespace revisit::core {

Posterior::Posterior(std::vector<LogOdds> histories,
                     double stretch_radius_meters)
    : histories_(std::move(histories)), radius_(stretch_radius_meters) {
  double greatest = 0.0;
  for (const LogOdds& history : histories_) {
    for (const ScoredEnds& ends : history.ends) {
      for (const ScoredEnd& end : ends) {
        greatest = std::max(greatest, end.score);
      }
    }
  }
  double sum = std::exp(-greatest);
  // Most terms are so small that the sum stays the same double.
  double largest = -greatest;
  const auto add = [&](const ScoredEnd& end) {
    const double term = end.score - greatest;
    if (term < largest - kNegligible) return;
    largest = std::max(largest, term);
    sum += end.nodes * std::exp(term);
  };
  for (const LogOdds& history : histories_) {
    for (const ScoredEnds& ends : history.ends) {
      std::for_each(ends.begin(), ends.end(), add);
    }
  }
  log_total_ = greatest + std::log(sum);
}

auto Posterior::Claim(std::size_t history, Direction direction, NodeIndex j)
    -> Stretch {
  const PoseGraph& graph = histories_[history].graph;
  ScoredEnds& ends = histories_[history].ends[IndexOf(direction)];
  const EndsAround around = FindEndsAround(
      ends, j, [&](NodeIndex i) { return graph.MetersApart(i, j) <= radius_; });
  Stretch stretch{0.0, j, j};
  std::vector<double> claimed;
  for (std::size_t k = around.first; k < around.last; ++k) {
    claimed.push_back(ends[k].nodes *
                      Probability(std::exchange(ends[k].score, kImpossible)));
    stretch.probability += claimed.back();
  }
  const double cut_off = 0.5 * (1.0 - kIntervalShare) * stretch.probability;
  std::size_t first = 0;
  for (double left = 0.0; first + 1 < claimed.size(); ++first) {
    left += claimed[first];
    if (left > cut_off) break;
  }
  std::size_t last = claimed.size();
  for (double left = 0.0; last > first + 1; --last) {
    left += claimed[last - 1];
    if (left > cut_off) break;
  }
  if (!claimed.empty()) {
    stretch.first = std::min(j, ends[around.first + first].node);
    stretch.last = std::max(j, ends[around.first + last - 1].node);
  }
  stretch.probability = std::min(stretch.probability, 1.0);
  return stretch;
}

double Posterior::Probability(double log_odds) const {
  return std::exp(log_odds - log_total_);
}

}  // namespace revisit::core
