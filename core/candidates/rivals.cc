#include "core/candidates/rivals.h"

#include <algorithm>
#include <utility>

#include "core/candidates/posterior.h"
#include "core/candidates/same_place.h"

namespace revisit::core {

Rivals::Rivals(const PoseGraph& graph, const RelativeModel& model,
               std::vector<RankedPlace> places)
    : places_(std::move(places)), same_(places_.size() * places_.size()) {
  FindSamePlaces(graph, model);
  Pool(graph);
}

void Rivals::FindSamePlaces(const PoseGraph& graph,
                            const RelativeModel& model) {
  for (std::size_t i = 0; i < places_.size(); ++i) {
    for (std::size_t j = 0; j < places_.size(); ++j) {
      const RankedPlace& a = places_[i];
      const RankedPlace& b = places_[j];
      if (i == j) {
        Same(i, j) = 1.0;
      } else if (a.direction == b.direction &&
                 b.claimed >= kLeastRivalProbability) {
        Same(i, j) = SamePlaceProbability(
            graph, model, a.end.matched, b.end.matched,
            std::min(a.log_likelihood_ratio, b.log_likelihood_ratio));
      }
    }
  }
}

void Rivals::Pool(const PoseGraph& graph) {
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const RankedPlace& place = places_[i];
    // The best end of a stretch stands for all of it.
    const bool stands = std::none_of(
        places_.begin(), places_.begin() + static_cast<int>(i),
        [&](const RankedPlace& better) {
          return better.direction == place.direction &&
                 graph.MetersApart(better.end.matched, place.end.matched) <=
                     2.0 * kPlaceRadiusMeters;
        });
    double probability = place.claimed;
    for (std::size_t j = 0; j < places_.size(); ++j) {
      if (stands && j != i) probability += Same(i, j) * places_[j].claimed;
    }
    probabilities_.push_back(std::min(probability, 1.0));
  }
}

double Rivals::RunnerUp(std::size_t i) const {
  double runner_up = 0.0;
  for (std::size_t j = 0; j < places_.size(); ++j) {
    const double without = probabilities_[j] - Same(j, i) * places_[i].claimed;
    runner_up = std::max(runner_up, (1.0 - Same(i, j)) * without);
  }
  return runner_up;
}

}  // namespace revisit::core
