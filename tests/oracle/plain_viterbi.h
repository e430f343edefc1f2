// The trellis of viterbi.h, edge by edge over the whole history, with every
// step kept.
#ifndef REVISIT_TESTS_ORACLE_PLAIN_VITERBI_H_
#define REVISIT_TESTS_ORACLE_PLAIN_VITERBI_H_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "tests/oracle/path_enumeration.h"

namespace revisit::oracle {

struct PlainViterbi {
  // By step, then node.
  std::vector<std::vector<double>> scores;
  std::vector<std::vector<core::NodeIndex>> before;

  std::vector<core::NodeIndex> Path(core::NodeIndex j) const {
    std::vector<core::NodeIndex> path;
    for (std::size_t t = scores.size(); t-- > 0;) {
      path.push_back(j);
      j = before[t][static_cast<std::size_t>(j)];
    }
    std::reverse(path.begin(), path.end());
    return path;
  }
};

inline PlainViterbi SolvePlainly(const core::PoseGraph& graph,
                                 const core::SimilarityModel& model,
                                 core::NodeIndex query, std::int64_t steps,
                                 core::NodeIndex size) {
  const auto count = static_cast<std::size_t>(size);
  std::vector<std::vector<core::NodeIndex>> edges;
  for (core::NodeIndex i = 0; i < size; ++i) {
    edges.push_back(Neighbours(graph, i, size));
  }
  PlainViterbi solved;
  for (std::int64_t t = 0; t < steps; ++t) {
    std::vector<double> emission;
    LogSimilarityColumn(graph, model, query - steps + 1 + t, size, &emission);
    std::vector<double> best(count, t == 0 ? 0.0 : core::kImpossible);
    std::vector<core::NodeIndex> from(count, -1);
    for (std::size_t i = 0; i < count && t > 0; ++i) {
      for (const core::NodeIndex h : edges[i]) {
        const auto at = static_cast<std::size_t>(h);
        const double over = solved.scores.back()[at] -
                            std::log(static_cast<double>(edges[at].size()));
        if (over > best[i]) {
          best[i] = over;
          from[i] = h;
        }
      }
    }
    for (std::size_t i = 0; i < count; ++i) best[i] += emission[i];
    solved.scores.push_back(best);
    solved.before.push_back(from);
  }
  return solved;
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_PLAIN_VITERBI_H_
