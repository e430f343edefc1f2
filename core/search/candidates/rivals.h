// How probable ranked places are against each other, where several of them may
// be passes of one and the same place.
//
// Each place has claimed the probability of its own nodes (Posterior::Claim()).
// Passes of one place speak for each other: to what a place has claimed comes
// what every other has, times the probability that the two are the same place
// (same_place.h), in whichever recordings they lie.
//
// But a road that many have driven is no likelier for that than another one
// (AverageOverPasses()).
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_RIVALS_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_RIVALS_H_

#include <cstddef>
#include <vector>

#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/candidates/ranking.h"

namespace revisit::core {

// An end that was ranked, and what its alignment found.
struct RankedPlace {
  // Index of its history among those searched.
  std::size_t history = 0;
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

// Places that claim less than this share of what the greatest claims are not
// asked whether they are passes of another.
inline constexpr double kLeastRivalShare = 1e-3;
// Places that are weighed against each other, at least, and at most so many
// more that are unlike them.
inline constexpr std::size_t kWeighed = 16;

class Rivals {
 public:
  // The places, best first, of which the first `answered` will be asked about,
  // or kWeighed if these are more. A road that was driven hundreds of times has
  // as many: all of them count, while only those that are weighed cost time,
  // O(places) each.
  // `frames`: those of the histories, or null where all are of one. All but the
  // places are needed only while this is made.
  Rivals(const std::vector<History>& histories, const FrameRelations* frames,
         const RelativeModel& model, std::vector<RankedPlace> places,
         std::size_t answered = 0);

  // Divides the odds of each place by how many passes it has, as far as they
  // are known: by the sum of the probabilities that the others are passes of
  // it. So a place is as probable as its passes are on average, however many
  // there are. What no place has claimed, and places that claim too little to
  // be asked, count as the others do on average. `new_place` is the probability
  // of a new place; returns the one that is left. The histories are those that
  // this was made with. Call at most once.
  double AverageOverPasses(const std::vector<History>& histories,
                           double new_place);

  const std::vector<RankedPlace>& places() const { return places_; }

  // Probability of place i, together with all other passes of it. What others
  // have claimed counts only for the best end of a stretch: a place within two
  // kPlaceRadiusMeters of a better one has what it claimed itself.
  // REQUIRES: i is weighed.
  double Probability(std::size_t i) const { return weighed_[i].probability; }

  // Probability of the best place other than i: without what it owes to i, and
  // as far as it is not the same place. 0 if there is none. REQUIRES: i is
  // weighed.
  double RunnerUp(std::size_t i) const;

 private:
  // A place that is weighed against all.
  struct Weighed {
    std::size_t place = 0;
    // For each place, the probability that it is another pass of this one.
    std::vector<double> same;
    double probability = 0.0;
  };

  class Passes;

  void Weigh(const std::vector<History>& histories, Passes* passes,
             std::size_t place);
  bool IsLikeAny(std::size_t place) const;
  // For each place how many passes it has, itself among them; 0 where that is
  // not known.
  std::vector<double> CountPasses() const;
  // The graph is that of the place's history.
  double Pooled(const PoseGraph& graph, const Weighed& weighed) const;

  std::vector<RankedPlace> places_;
  double least_claimed_ = 0.0;
  // The first places, then others.
  std::vector<Weighed> weighed_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_RIVALS_H_
