#include "core/candidates/ranking.h"

#include <cstddef>

#include "core/alignment/log_similarity.h"

namespace revisit::core {

void StrikeOut(const PoseGraph& graph, NodeIndex centre,
               double separation_meters, std::vector<double>* scores) {
  const auto size = static_cast<NodeIndex>(scores->size());
  // Travelled distance grows with the index, so what is near is a range.
  const auto near = [&](NodeIndex i) {
    return i == centre || graph.MetersApart(i, centre) < separation_meters;
  };
  for (NodeIndex i = centre; i >= 0 && near(i); --i) {
    if (i < size) (*scores)[static_cast<std::size_t>(i)] = kImpossible;
  }
  for (NodeIndex i = centre + 1; i < size && near(i); ++i) {
    (*scores)[static_cast<std::size_t>(i)] = kImpossible;
  }
}

std::vector<RankedEnd> RankEnds(const PoseGraph& graph,
                                std::vector<double> scores,
                                double separation_meters, int max_candidates) {
  std::vector<RankedEnd> ends;
  while (static_cast<int>(ends.size()) < max_candidates) {
    RankedEnd best{-1, kImpossible};
    for (std::size_t i = 0; i < scores.size(); ++i) {
      if (scores[i] > best.score) {
        best = {static_cast<NodeIndex>(i), scores[i]};
      }
    }
    if (best.matched < 0) break;
    ends.push_back(best);
    StrikeOut(graph, best.matched, separation_meters, &scores);
  }
  return ends;
}

}  // namespace revisit::core
