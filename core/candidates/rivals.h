// How probable ranked places are against each other, where several of them may
// be passes of one and the same place.
//
// Each place has claimed the probability of its own nodes (Posterior::Claim()).
// Passes of one place speak for each other: to what a place has claimed comes
// what every other has, times the probability that the two are the same place
// (same_place.h).
#ifndef REVISIT_CORE_CANDIDATES_RIVALS_H_
#define REVISIT_CORE_CANDIDATES_RIVALS_H_

#include <cstddef>
#include <vector>

#include "core/alignment/log_similarity.h"
#include "core/alignment/relative_model.h"
#include "core/candidates/ranking.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// An end that was ranked, and what its alignment found.
struct RankedPlace {
  Direction direction = Direction::kSame;
  RankedEnd end;
  // ShapeMatch::log_likelihood_ratio.
  double log_likelihood_ratio = 0.0;
  // Probability of the nodes that it has claimed for itself, and those between
  // which the place lies (Posterior::Stretch).
  double claimed = 0.0;
  NodeIndex first = 0;
  NodeIndex last = 0;
};

// Places less probable than this are not asked whether they are passes of
// another.
inline constexpr double kLeastRivalProbability = 1e-3;

class Rivals {
 public:
  // The places, best first. Computed here once: O(places^2).
  Rivals(const PoseGraph& graph, const RelativeModel& model,
         std::vector<RankedPlace> places);

  const std::vector<RankedPlace>& places() const { return places_; }

  // Probability of place i, together with all other passes of it. What others
  // have claimed counts only for the best end of a stretch: a place within two
  // kPlaceRadiusMeters of a better one has what it claimed itself.
  double Probability(std::size_t i) const { return probabilities_[i]; }

  // Probability of the best place other than i: without what it owes to i, and
  // as far as it is not the same place. 0 if there is none.
  double RunnerUp(std::size_t i) const;

 private:
  void FindSamePlaces(const PoseGraph& graph, const RelativeModel& model);
  void Pool(const PoseGraph& graph);

  // Probability that places i and j are passes of one place.
  double& Same(std::size_t i, std::size_t j) {
    return same_[i * places_.size() + j];
  }
  double Same(std::size_t i, std::size_t j) const {
    return same_[i * places_.size() + j];
  }

  std::vector<RankedPlace> places_;
  std::vector<double> same_;
  std::vector<double> probabilities_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_RIVALS_H_
