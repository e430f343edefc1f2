// The ends that an alignment finds, each with the best path back from it.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_FOUND_ENDS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_FOUND_ENDS_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/search/alignment/scored_ends.h"

namespace revisit::core {

// The best path back from one history node.
struct ShapeMatch {
  double log_likelihood_ratio = 0.0;
  // Sum over its steps.
  double squared_innovations = 0.0;
  // (d + a)^T (Gamma + R - A)^-1 (d + a): for the end's difference as estimated
  // from the whole path.
  double squared_end_difference = 0.0;
  // The scale, times SimilarityModel::inflation, that Gamma has there: that of
  // the most probable part of the mixture.
  double scale = 1.0;
  // Steps of the recent path that it covers; 0 for the end alone.
  std::int64_t steps = 0;
  // In another recording, the way in which its frame most probably lies there
  // (Anchors::Mixture).
  std::size_t way = 0;
};

// Ends of one direction, sorted by node.
struct MatchedEnds {
  ScoredEnds ends;
  // One for each end.
  std::vector<ShapeMatch> matches;
  // The log-odds of each end under each scale alone, where these are told.
  std::vector<double> odds_by_scale;
};

// Collects the ends of one direction, in any order.
class FoundEnds {
 public:
  // `scales`: how many scales each end tells its odds under.
  explicit FoundEnds(std::size_t scales) : scales_(scales) {}

  void Add(const ScoredEnd& end, const ShapeMatch& match) {
    found_.push_back({end, match, odds_by_scale_.size()});
  }
  // Where the log-odds of the end that was added last go, as many as there are
  // scales.
  std::vector<double>* odds_by_scale() { return &odds_by_scale_; }

  // The ends that were found, except for those of lower log-odds.
  MatchedEnds HandOver(double least);

 private:
  struct Found {
    ScoredEnd end;
    ShapeMatch match;
    // Where its log-odds under each scale begin.
    std::size_t first_scale = 0;
  };

  std::size_t scales_;
  // In the order in which they were found.
  std::vector<Found> found_;
  std::vector<double> odds_by_scale_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_FOUND_ENDS_H_
