#include "client/evaluation/evaluation.h"

#include <algorithm>
#include <cmath>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

// Travelled distances are sums of many steps.
constexpr double kRounding = 1e-6;

std::optional<double> Ratio(double numerator, double denominator) {
  if (denominator <= 0.0) return std::nullopt;
  return numerator / denominator;
}

bool SameCandidate(const CandidateAnswer& a, const CandidateAnswer& b) {
  return a.matched == b.matched && a.verdict == b.verdict &&
         a.path_gate == b.path_gate && a.has_gate == b.has_gate &&
         a.squared_distance == b.squared_distance &&
         a.threshold == b.threshold && a.p_value == b.p_value &&
         a.probability == b.probability && a.meters_before == b.meters_before &&
         a.meters_after == b.meters_after && a.opposite == b.opposite &&
         a.frame_state == b.frame_state && a.confidence == b.confidence;
}

// The answer without candidates in the asking recording; all of it where there
// is one recording.
CheckAnswer WithoutAsking(const CheckAnswer& answer,
                          std::int64_t first_asking) {
  CheckAnswer left = answer;
  if (first_asking == 0) return left;
  auto& candidates = left.candidates;
  candidates.erase(std::remove_if(candidates.begin(), candidates.end(),
                                  [&](const CandidateAnswer& candidate) {
                                    return candidate.matched >= first_asking;
                                  }),
                   candidates.end());
  if (candidates.empty() && !answer.candidates.empty()) {
    left.empty_reason = "all are in the recording that asks";
  }
  return left;
}

// Whether is_place(node) for any node between which the place may lie.
template <typename IsPlace>
bool AnyInInterval(const std::vector<GraphNode>& nodes,
                   const CandidateAnswer& candidate, const IsPlace& is_place) {
  const auto travelled = [&nodes](std::int64_t node) {
    return nodes[static_cast<std::size_t>(node)].travelled_meters;
  };
  const double at = travelled(candidate.matched);
  const double least = at - candidate.meters_before - kRounding;
  const double most = at + candidate.meters_after + kRounding;
  for (std::int64_t i = candidate.matched; i >= 0 && travelled(i) >= least;
       --i) {
    if (is_place(i)) return true;
  }
  const auto end = static_cast<std::int64_t>(nodes.size());
  for (std::int64_t i = candidate.matched; i < end && travelled(i) <= most;
       ++i) {
    if (is_place(i)) return true;
  }
  return false;
}

// Counts the candidates of any rank that somebody would have to verify.
void CountVerification(const JudgedCheck& check, Tally* tally) {
  bool found = false;
  bool seen = false;
  for (std::size_t i = 0; i < check.correct.size(); ++i) {
    if (check.answer.candidates[i].verdict != v1::VERDICT_ACCEPTED) continue;
    ++tally->to_verify;
    tally->looks += LooksAt(check.answer.candidates[i]);
    found = found || check.correct[i];
    seen = seen || check.holds[i];
  }
  if (found) ++tally->loops_found;
  if (seen) ++tally->loops_seen;
}

// Counts the confidence and the probability that are stated of the first
// candidate, or of there being none.
void CountStatements(const JudgedCheck& check, Tally* tally) {
  if (check.correct.empty()) {
    // The best that was left out.
    if (check.answer.none_probable)
      tally->probabilities.push_back({0.0, false});
    return;
  }
  const CandidateAnswer& first = check.answer.candidates[0];
  tally->confidences.push_back({first.confidence, check.top_correct()});
  if (!first.probability.has_value()) return;
  tally->probabilities.push_back({*first.probability, check.top_correct()});
  if (*first.probability >= kSure && check.top_correct()) {
    ++tally->sure_correct;
  }
}

}  // namespace

std::int64_t LooksAt(const CandidateAnswer& candidate) {
  const double meters = candidate.meters_before + candidate.meters_after;
  return std::max<std::int64_t>(
      1, std::llround(std::ceil(meters / (2.0 * kLookMeters))));
}

bool SameAnswer(const CheckAnswer& a, const CheckAnswer& b) {
  return a.query == b.query && a.empty_reason == b.empty_reason &&
         std::equal(a.candidates.begin(), a.candidates.end(),
                    b.candidates.begin(), b.candidates.end(), SameCandidate);
}

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

std::optional<double> Tally::top1() const {
  return Ratio(static_cast<double>(top1_correct),
               static_cast<double>(true_loops));
}

std::optional<double> Tally::recall_at_5() const {
  return Ratio(static_cast<double>(top5_correct),
               static_cast<double>(true_loops));
}

std::optional<double> Tally::calibration_error() const {
  return ExpectedCalibrationError(probabilities);
}

std::optional<double> Tally::positive_calibration_error() const {
  return PositiveCalibrationError(probabilities);
}

std::optional<double> Tally::sure_recall() const {
  if (probabilities.empty()) return std::nullopt;
  return Ratio(static_cast<double>(sure_correct),
               static_cast<double>(true_loops));
}

std::optional<double> Tally::to_verify_per_loop() const {
  return Ratio(static_cast<double>(to_verify),
               static_cast<double>(loops_found));
}

std::optional<double> Tally::looks_per_loop() const {
  return Ratio(static_cast<double>(looks), static_cast<double>(loops_seen));
}

std::optional<double> Tally::interval_precision() const {
  return Ratio(static_cast<double>(accepted_holding),
               static_cast<double>(accepted));
}

std::optional<double> Tally::interval_recall() const {
  return Ratio(static_cast<double>(accepted_holding),
               static_cast<double>(true_loops));
}

std::optional<double> Tally::poses_per_second() const {
  return Ratio(static_cast<double>(timed_poses), seconds);
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
  accepted_holding += other.accepted_holding;
  top1_correct += other.top1_correct;
  top5_correct += other.top5_correct;
  sure_correct += other.sure_correct;
  to_verify += other.to_verify;
  loops_found += other.loops_found;
  looks += other.looks;
  loops_seen += other.loops_seen;
  const auto append = [](auto* to, const auto& from) {
    to->insert(to->end(), from.begin(), from.end());
  };
  append(&confidences, other.confidences);
  append(&probabilities, other.probabilities);
  append(&search_milliseconds, other.search_milliseconds);
  new_road_checks += other.new_road_checks;
  new_road_accepted += other.new_road_accepted;
  confirmed += other.confirmed;
  rejected += other.rejected;
  jumps += other.jumps;
  poses += other.poses;
  timed_poses += other.timed_poses;
  seconds += other.seconds;
}

PlanarPose TruthAt(std::uint64_t sequence, double fraction,
                   const std::vector<PlanarPose>& truth) {
  const std::size_t index = static_cast<std::size_t>(sequence) - 1;
  const PlanarPose& before = truth[index];
  const PlanarPose& after = truth[std::min(index + 1, truth.size() - 1)];
  const double turn = std::remainder(after.heading - before.heading, kTurn);
  return {before.x + fraction * (after.x - before.x),
          before.y + fraction * (after.y - before.y),
          std::remainder(before.heading + fraction * turn, kTurn)};
}

std::vector<PlanarPose> TruthAtNodes(const std::vector<GraphNode>& nodes,
                                     const std::vector<PlanarPose>& truth) {
  std::vector<PlanarPose> at_nodes;
  at_nodes.reserve(nodes.size());
  for (const GraphNode& node : nodes) {
    at_nodes.push_back(TruthAt(node.sequence, node.fraction, truth));
  }
  return at_nodes;
}

bool SamePlace(const PlanarPose& a, const PlanarPose& b, bool opposite,
               const Judging& judging) {
  const double turn = b.heading - a.heading - (opposite ? kPi : 0.0);
  return std::hypot(a.x - b.x, a.y - b.y) <= judging.loop_distance_meters &&
         std::abs(std::remainder(turn, kTurn)) <= judging.loop_heading_radians;
}

std::vector<JudgedCheck> Judge(const std::vector<GraphNode>& nodes,
                               const std::vector<PlanarPose>& truth_at_nodes,
                               const std::vector<CheckAnswer>& answers,
                               const Judging& judging) {
  std::vector<JudgedCheck> checks;
  const std::int64_t first_asking = judging.first_asking_node;
  const double begins_at =
      first_asking < static_cast<std::int64_t>(nodes.size())
          ? nodes[static_cast<std::size_t>(first_asking)].travelled_meters
          : 0.0;
  for (const CheckAnswer& given : answers) {
    const CheckAnswer answer = WithoutAsking(given, first_asking);
    const auto query = static_cast<std::size_t>(answer.query);
    if (answer.query < first_asking || answer.query <= judging.counted_behind ||
        nodes[query].travelled_meters - (first_asking > 0 ? begins_at : 0.0) <
            judging.first_check_meters - kRounding) {
      continue;
    }
    const std::int64_t last = first_asking > 0
                                  ? first_asking - 1
                                  : answer.query - judging.excluded_nodes;
    const PlanarPose& here = truth_at_nodes[query];
    JudgedCheck check;
    for (std::int64_t i = 0; i <= last && !check.true_loop; ++i) {
      const PlanarPose& there = truth_at_nodes[static_cast<std::size_t>(i)];
      check.true_loop = (judging.direction != PassDirection::kOpposite &&
                         SamePlace(here, there, false, judging)) ||
                        (judging.direction != PassDirection::kSame &&
                         SamePlace(here, there, true, judging));
    }
    if (first_asking > 0) {
      Judging near = judging;
      near.loop_distance_meters = kNewRoadMeters;
      check.new_road = std::none_of(
          truth_at_nodes.begin(), truth_at_nodes.begin() + first_asking,
          [&](const PlanarPose& there) {
            return SamePlace(here, there, false, near);
          });
    }
    for (const CandidateAnswer& candidate : answer.candidates) {
      const auto is_place = [&](std::int64_t node) {
        return node <= last &&
               SamePlace(here, truth_at_nodes[static_cast<std::size_t>(node)],
                         candidate.opposite, judging);
      };
      check.correct.push_back(is_place(candidate.matched));
      check.holds.push_back(AnyInInterval(nodes, candidate, is_place));
    }
    check.answer = answer;
    if (judging.only_revisited && checks.empty() && !check.true_loop) continue;
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
    if (check.new_road) ++tally.new_road_checks;
    if (check.new_road && check.accepted()) ++tally.new_road_accepted;
    if (check.accepted()) ++tally.accepted;
    if (check.accepted() && check.top_correct()) ++tally.accepted_correct;
    if (check.top_correct()) ++tally.top1_correct;
    const auto end =
        check.correct.begin() +
        static_cast<std::ptrdiff_t>(std::min(kFirst, check.correct.size()));
    if (std::find(check.correct.begin(), end, true) != end) {
      ++tally.top5_correct;
    }
    if (check.accepted() && check.holds[0]) ++tally.accepted_holding;
    CountVerification(check, &tally);
    CountStatements(check, &tally);
    if (check.answer.search_milliseconds.has_value()) {
      tally.search_milliseconds.push_back(*check.answer.search_milliseconds);
    }
  }
  return tally;
}

}  // namespace revisit::client
