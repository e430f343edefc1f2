#include "core/search/alignment/scored_ends.h"

#include "core/search/alignment/log_similarity.h"

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

void StrikeOut(const NodeRange& nodes, ScoredEnds* ends) {
  const auto first = std::partition_point(
      ends->begin(), ends->end(),
      [&](const ScoredEnd& end) { return end.node < nodes.first; });
  for (auto end = first; end != ends->end() && end->node < nodes.last; ++end) {
    end->score = kImpossible;
  }
}

}  // namespace revisit::core
