#include "client/cli/evaluation.h"

#include <algorithm>
#include <cmath>

namespace revisit::client {
namespace {

constexpr double kTurn = 2.0 * 3.14159265358979323846;

bool SamePlace(const PlanarPose& a, const PlanarPose& b,
               const Judging& judging) {
  return std::hypot(a.x - b.x, a.y - b.y) <= judging.loop_distance_meters &&
         std::abs(std::remainder(a.heading - b.heading, kTurn)) <=
             judging.loop_heading_radians;
}

std::optional<double> Ratio(double numerator, double denominator) {
  if (denominator <= 0.0) return std::nullopt;
  return numerator / denominator;
}

}  // namespace

std::optional<double> Tally::precision() const {
  return Ratio(static_cast<double>(accepted_correct),
               static_cast<double>(accepted));
}

std::optional<double> Tally::recall() const {
  return Ratio(static_cast<double>(accepted_correct),
               static_cast<double>(true_loops));
}

std::optional<double> Tally::f1() const {
  return Ratio(2.0 * static_cast<double>(accepted_correct),
               static_cast<double>(accepted + true_loops));
}

std::optional<double> Tally::to_verify_per_loop() const {
  return Ratio(static_cast<double>(to_verify),
               static_cast<double>(loops_found));
}

std::optional<double> Tally::poses_per_second() const {
  return Ratio(static_cast<double>(poses), seconds);
}

std::optional<double> Tally::search_percentile(double percent) const {
  if (search_milliseconds.empty()) return std::nullopt;
  std::vector<double> sorted = search_milliseconds;
  std::sort(sorted.begin(), sorted.end());
  const double rank =
      std::ceil(percent / 100.0 * static_cast<double>(sorted.size()));
  const auto index = static_cast<std::size_t>(std::max(rank, 1.0)) - 1;
  return sorted[std::min(index, sorted.size() - 1)];
}

void Tally::Add(const Tally& other) {
  checks += other.checks;
  true_loops += other.true_loops;
  accepted += other.accepted;
  accepted_correct += other.accepted_correct;
  top1_correct += other.top1_correct;
  top5_correct += other.top5_correct;
  to_verify += other.to_verify;
  loops_found += other.loops_found;
  search_milliseconds.insert(search_milliseconds.end(),
                             other.search_milliseconds.begin(),
                             other.search_milliseconds.end());
  poses += other.poses;
  seconds += other.seconds;
}

std::vector<PlanarPose> TruthAtNodes(const std::vector<GraphNode>& nodes,
                                     const std::vector<PlanarPose>& truth) {
  std::vector<PlanarPose> at_nodes;
  at_nodes.reserve(nodes.size());
  for (const GraphNode& node : nodes) {
    const std::size_t index = static_cast<std::size_t>(node.sequence) - 1;
    const PlanarPose& before = truth[index];
    const PlanarPose& after = truth[std::min(index + 1, truth.size() - 1)];
    const double turn = std::remainder(after.heading - before.heading, kTurn);
    at_nodes.push_back(
        {before.x + node.fraction * (after.x - before.x),
         before.y + node.fraction * (after.y - before.y),
         std::remainder(before.heading + node.fraction * turn, kTurn)});
  }
  return at_nodes;
}

std::vector<JudgedCheck> Judge(const std::vector<GraphNode>& nodes,
                               const std::vector<PlanarPose>& truth_at_nodes,
                               const std::vector<CheckAnswer>& answers,
                               const Judging& judging) {
  // Travelled distances are sums of many steps.
  constexpr double kRounding = 1e-6;
  std::vector<JudgedCheck> checks;
  for (const CheckAnswer& answer : answers) {
    const auto query = static_cast<std::size_t>(answer.query);
    if (nodes[query].travelled_meters <
        judging.first_check_meters - kRounding) {
      continue;
    }
    const std::int64_t last = answer.query - judging.excluded_nodes;
    const PlanarPose& here = truth_at_nodes[query];
    JudgedCheck check;
    for (std::int64_t i = 0; i <= last && !check.true_loop; ++i) {
      check.true_loop =
          SamePlace(here, truth_at_nodes[static_cast<std::size_t>(i)], judging);
    }
    for (const CandidateAnswer& candidate : answer.candidates) {
      check.correct.push_back(
          candidate.matched <= last &&
          SamePlace(here,
                    truth_at_nodes[static_cast<std::size_t>(candidate.matched)],
                    judging));
    }
    check.answer = answer;
    checks.push_back(std::move(check));
  }
  return checks;
}

Tally Count(const std::vector<JudgedCheck>& checks) {
  constexpr std::size_t kFirst = 5;
  Tally tally;
  for (const JudgedCheck& check : checks) {
    ++tally.checks;
    if (check.true_loop) ++tally.true_loops;
    if (check.accepted()) ++tally.accepted;
    if (check.accepted() && check.top_correct()) ++tally.accepted_correct;
    if (check.top_correct()) ++tally.top1_correct;
    const auto end =
        check.correct.begin() +
        static_cast<std::ptrdiff_t>(std::min(kFirst, check.correct.size()));
    if (std::find(check.correct.begin(), end, true) != end) {
      ++tally.top5_correct;
    }
    bool found = false;
    for (std::size_t i = 0; i < check.correct.size(); ++i) {
      if (check.answer.candidates[i].verdict !=
          CandidateAnswer::Verdict::kAccepted) {
        continue;
      }
      ++tally.to_verify;
      found = found || check.correct[i];
    }
    if (found) ++tally.loops_found;
    tally.search_milliseconds.push_back(check.answer.search_milliseconds);
  }
  return tally;
}

}  // namespace revisit::client
