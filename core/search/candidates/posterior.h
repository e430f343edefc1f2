// How probable each place of the histories is, against the other places and
// against a place not seen before.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_POSTERIOR_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_POSTERIOR_H_

#include <array>
#include <cstddef>
#include <vector>

#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/noise/noise_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/scored_ends.h"

namespace revisit::core {

// Nodes this close to a place along the path are on its stretch of road, where
// errors are carried on. How probable the stretch is says whether the vehicle
// is on this road; where it is on it may be less sure, where the road is
// straight and drift is wide. Where each pose tells its place by itself, the
// stretch is the place.
inline constexpr double kStretchRadiusMeters = 40.0;
inline double StretchRadiusMeters(const NoiseModel& noise) {
  return noise.fixes_place ? kPlaceRadiusMeters : kStretchRadiusMeters;
}

// Share of the probability of a stretch that lies within its interval.
inline constexpr double kIntervalShare = 0.9;

// Log-odds of the nodes of one history against a new place, for each direction;
// empty for a direction that was not sought. All histories have the same new
// place, so that the odds of one add to those of the others. The graph is that
// of the history, and must outlive this.
struct LogOdds {
  const PoseGraph& graph;
  std::array<ScoredEnds, 2> ends;
};

class Posterior {
 public:
  // Stretches reach as far from their places.
  Posterior(std::vector<LogOdds> histories, double stretch_radius_meters);

  // Probability that the vehicle is at no place of any history.
  double new_place() const { return Probability(0.0); }

  // The evidence that a place has claimed.
  struct Stretch {
    double probability = 0.0;
    // The nodes between which the place lies with kIntervalShare of that
    // probability, as much cut off on either side; j is between them.
    NodeIndex first = 0;
    NodeIndex last = 0;
  };

  // Claims for the place of node j of a history all nodes of its stretch that
  // no other place has claimed before. So nodes that two neighbouring places
  // share count for the first to claim. O(log n + nodes claimed).
  Stretch Claim(std::size_t history, Direction direction, NodeIndex j);

 private:
  double Probability(double log_odds) const;

  // kImpossible for nodes that are claimed.
  std::vector<LogOdds> histories_;
  const double radius_;
  // Logarithm of the sum of all odds, the new place's 1 among them.
  double log_total_ = 0.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_POSTERIOR_H_
