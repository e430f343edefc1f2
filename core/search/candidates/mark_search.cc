#include "core/search/candidates/mark_search.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/relative.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/belief/log_odds.h"
#include "core/search/candidates/relative_search.h"

namespace revisit::core {
namespace {

// Ends that have at most this share of all odds together are pruned: evidence
// that counts for a tenth of an observation needs no more (kPrunedShare).
constexpr double kPrunedMarkShare = 1e-3;

// The odds of ends, summed for each scale.
class OddsByScale {
 public:
  OddsByScale() { log_sums_.fill(kImpossible); }

  void Add(const double* log_odds, double nodes) {
    const double log_nodes = std::log(nodes);
    for (std::size_t k = 0; k < kScales; ++k) {
      log_sums_[k] = LogAdd(log_sums_[k], log_odds[k] + log_nodes);
    }
  }
  double operator[](std::size_t k) const { return log_sums_[k]; }

 private:
  ByScale log_sums_;
};

}  // namespace

absl::StatusOr<MarkEvidence> SearchMark(const SearchTask& task) {
  RelativeModel model = ModelOf(task, kPrunedMarkShare);
  model.last_confirmed.reset();
  model.over_loops = false;
  model.scales = DriveBelief().AllScales();
  model.tell_scales = true;
  const std::optional<RelativeAlignment> alignment =
      AlignRelative(task.graph, model, task.query, task.steps,
                    task.history_size, task.should_stop, task.parts);
  if (!alignment) return StoppedError();
  MarkEvidence evidence;
  evidence.node = task.query;
  double best = kImpossible;
  Direction best_direction = Direction::kSame;
  OddsByScale all;
  for (const Direction direction : Directions(task.options.direction)) {
    const ScoredEnds& ends = alignment->ends(direction);
    const std::vector<double>& odds = alignment->odds_by_scale(direction);
    for (std::size_t i = 0; i < ends.size(); ++i) {
      all.Add(&odds[i * kScales], ends[i].nodes);
      if (!(ends[i].score > best)) continue;
      best = ends[i].score;
      best_direction = direction;
      evidence.matched = ends[i].node;
    }
  }
  OddsByScale near;
  if (evidence.matched) {
    const ScoredEnds& ends = alignment->ends(best_direction);
    const std::vector<double>& odds = alignment->odds_by_scale(best_direction);
    const EndsAround around =
        FindEndsAround(ends, *evidence.matched, [&](NodeIndex i) {
          return task.graph.MetersApart(i, *evidence.matched) <=
                 kMatchRadiusMeters;
        });
    for (std::size_t i = around.first; i < around.last; ++i) {
      near.Add(&odds[i * kScales], ends[i].nodes);
    }
  }
  for (std::size_t k = 0; k < kScales; ++k) {
    evidence.log_evidence[k] = LogAdd(0.0, all[k]);
    evidence.log_matched_odds[k] = near[k];
  }
  return evidence;
}

}  // namespace revisit::core
