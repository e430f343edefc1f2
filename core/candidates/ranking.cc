#include "core/candidates/ranking.h"

#include <cmath>
#include <cstddef>

namespace revisit::core {

std::vector<RankedEnd> RankEnds(const PoseGraph& graph,
                                const Alignment& alignment, NodeIndex query,
                                double separation_meters, int max_candidates) {
  std::vector<double> scores(static_cast<std::size_t>(alignment.size()));
  for (NodeIndex i = 0; i < alignment.size(); ++i) {
    scores[static_cast<std::size_t>(i)] = alignment.score(i);
  }
  // Travelled distance grows with the index, so what is near is a range.
  const auto strike_out = [&](NodeIndex centre) {
    const double at = graph.node(centre).travelled_meters;
    const auto near = [&](NodeIndex i) {
      return i == centre ||
             std::abs(graph.node(i).travelled_meters - at) < separation_meters;
    };
    for (NodeIndex i = centre; i >= 0 && near(i); --i) {
      if (i < alignment.size())
        scores[static_cast<std::size_t>(i)] = kImpossible;
    }
    for (NodeIndex i = centre + 1; i < alignment.size() && near(i); ++i) {
      scores[static_cast<std::size_t>(i)] = kImpossible;
    }
  };

  strike_out(query);
  std::vector<RankedEnd> ends;
  while (static_cast<int>(ends.size()) < max_candidates) {
    RankedEnd best{-1, kImpossible};
    for (NodeIndex i = 0; i < alignment.size(); ++i) {
      const double score = scores[static_cast<std::size_t>(i)];
      if (score > best.score) best = {i, score};
    }
    if (best.matched < 0) break;
    ends.push_back(best);
    strike_out(best.matched);
  }
  return ends;
}

}  // namespace revisit::core
