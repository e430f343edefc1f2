// The best alignment by trying every path of the history: exponential, obvious.
#ifndef REVISIT_TESTS_ORACLE_PATH_ENUMERATION_H_
#define REVISIT_TESTS_ORACLE_PATH_ENUMERATION_H_

#include <cmath>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"

namespace revisit::oracle {

struct BestPath {
  double score = core::kImpossible;
  std::vector<core::NodeIndex> nodes;
};

// Neighbours of a node among [0, size), once for each edge.
inline std::vector<core::NodeIndex> Neighbours(const core::PoseGraph& graph,
                                               core::NodeIndex i,
                                               core::NodeIndex size) {
  std::vector<core::NodeIndex> neighbours;
  if (graph.SegmentStart(i) != i) neighbours.push_back(i - 1);
  if (i + 1 < size && graph.SegmentStart(i + 1) != i + 1) {
    neighbours.push_back(i + 1);
  }
  for (core::NodeIndex other : graph.LoopNeighbours(i)) {
    if (other < size) neighbours.push_back(other);
  }
  return neighbours;
}

inline void Extend(const core::PoseGraph& graph,
                   const core::SimilarityModel& model,
                   core::NodeIndex first_recent, std::size_t steps,
                   core::NodeIndex size, double score,
                   std::vector<core::NodeIndex>* path,
                   std::vector<BestPath>* best) {
  const core::NodeIndex at = path->back();
  const auto recent =
      first_recent + static_cast<core::NodeIndex>(path->size()) - 1;
  score += core::LogSimilarity(graph, model, recent, at);
  if (path->size() == steps) {
    BestPath& known = (*best)[static_cast<std::size_t>(at)];
    if (score > known.score) known = {score, *path};
    return;
  }
  const auto neighbours = Neighbours(graph, at, size);
  for (core::NodeIndex next : neighbours) {
    path->push_back(next);
    Extend(graph, model, first_recent, steps, size,
           score - std::log(static_cast<double>(neighbours.size())), path,
           best);
    path->pop_back();
  }
}

// The best path to each node of the history [0, size).
inline std::vector<BestPath> EnumeratePaths(const core::PoseGraph& graph,
                                            const core::SimilarityModel& model,
                                            core::NodeIndex query,
                                            std::int64_t steps,
                                            core::NodeIndex size) {
  std::vector<BestPath> best(static_cast<std::size_t>(size));
  for (core::NodeIndex start = 0; start < size; ++start) {
    std::vector<core::NodeIndex> path{start};
    Extend(graph, model, query - steps + 1, static_cast<std::size_t>(steps),
           size, 0.0, &path, &best);
  }
  return best;
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_PATH_ENUMERATION_H_
