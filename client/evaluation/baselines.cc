#include "client/evaluation/baselines.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace revisit::client {

namespace {

// The answer to one check: the nearest nodes beyond the recent path, apart from
// each other along the path.
CheckAnswer NearestTo(const std::vector<GraphNode>& nodes, std::int64_t query,
                      const NearestPosition& options) {
  const auto node = [&](std::int64_t index) -> const GraphNode& {
    return nodes[static_cast<std::size_t>(index)];
  };
  const PlanarPose& here = node(query).estimate;
  std::vector<std::pair<double, std::int64_t>> near;
  for (std::int64_t i = 0; i <= query - options.excluded_nodes; ++i) {
    const PlanarPose& there = node(i).estimate;
    const double distance = std::hypot(there.x - here.x, there.y - here.y);
    if (distance <= options.radius_meters) near.emplace_back(distance, i);
  }
  std::sort(near.begin(), near.end());
  CheckAnswer answer;
  answer.query = query;
  for (const auto& [distance, index] : near) {
    if (answer.candidates.size() == options.max_candidates) break;
    const double travelled = node(index).travelled_meters;
    const bool apart = std::all_of(
        answer.candidates.begin(), answer.candidates.end(),
        [&](const CandidateAnswer& other) {
          return std::abs(node(other.matched).travelled_meters - travelled) >=
                 options.separation_meters;
        });
    if (!apart) continue;
    CandidateAnswer candidate;
    candidate.matched = index;
    candidate.verdict = v1::VERDICT_ACCEPTED;
    candidate.confidence = -distance;
    answer.candidates.push_back(candidate);
  }
  if (answer.candidates.empty()) {
    answer.empty_reason = "no node of the history is near";
  }
  return answer;
}

}  // namespace

std::vector<CheckAnswer> FindNearestPositions(
    const std::vector<GraphNode>& nodes,
    const std::vector<std::int64_t>& queries, const NearestPosition& options) {
  std::vector<CheckAnswer> answers;
  for (const std::int64_t query : queries) {
    answers.push_back(NearestTo(nodes, query, options));
  }
  return answers;
}

void LeaveOutRecentPath(std::int64_t excluded_nodes, std::size_t max_candidates,
                        CheckAnswer* answer) {
  auto& candidates = answer->candidates;
  const std::int64_t last = answer->query - excluded_nodes;
  candidates.erase(std::remove_if(candidates.begin(), candidates.end(),
                                  [&](const CandidateAnswer& candidate) {
                                    return candidate.matched > last;
                                  }),
                   candidates.end());
  if (candidates.size() > max_candidates) candidates.resize(max_candidates);
  if (candidates.empty() && answer->empty_reason.empty()) {
    answer->empty_reason = "all candidates lie on the recent path";
  }
}

}  // namespace revisit::client
