// Methods to compare with, which find candidates without aligning anything.
#ifndef REVISIT_CLIENT_EVALUATION_BASELINES_H_
#define REVISIT_CLIENT_EVALUATION_BASELINES_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "client/evaluation/evaluation.h"

namespace revisit::client {

struct NearestPosition {
  // Candidates lie within this distance of the query's estimate, whatever the
  // uncertainty. All are accepted.
  double radius_meters = 15.0;
  // The recent path that is no history.
  std::int64_t excluded_nodes = 75;
  // Least distance along the path between candidates, and most candidates of
  // one answer: VehicleSettings has the same two.
  double separation_meters = 10.0;
  std::size_t max_candidates = 5;
};

// The answer at each query node: the nodes of the history whose estimated
// position is nearest, nearest first, older first where they tie. Their
// confidence is the distance, negated.
std::vector<CheckAnswer> FindNearestPositions(
    const std::vector<GraphNode>& nodes,
    const std::vector<std::int64_t>& queries, const NearestPosition& options);

// Keeps the first `max_candidates` candidates that do not lie on the last
// `excluded_nodes` nodes before the query.
void LeaveOutRecentPath(std::int64_t excluded_nodes, std::size_t max_candidates,
                        CheckAnswer* answer);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_BASELINES_H_
