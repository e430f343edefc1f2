#include "core/alignment/scored_ends.h"

#include "core/alignment/log_similarity.h"

namespace revisit::core {

ScoredEnds PossibleEnds(const std::vector<double>& scores) {
  ScoredEnds ends;
  ends.reserve(scores.size());
  for (std::size_t i = 0; i < scores.size(); ++i) {
    if (scores[i] != kImpossible) {
      ends.push_back({static_cast<NodeIndex>(i), scores[i]});
    }
  }
  return ends;
}

}  // namespace revisit::core
