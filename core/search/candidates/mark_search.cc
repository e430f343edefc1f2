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

// An end in one of the directions.
struct DirectedEnd {
  Direction direction = Direction::kSame;
  NodeIndex node = 0;
  double score = 0.0;
};

// The most probable end, if any is possible; of equal ones, the first.
std::optional<DirectedEnd> MostProbable(const RelativeAlignment& alignment,
                                        SearchDirection sought) {
  std::optional<DirectedEnd> most_probable;
  double best = kImpossible;
  for (const Direction direction : Directions(sought)) {
    for (const ScoredEnd& end : alignment.ends(direction)) {
      if (!(end.score > best)) continue;
      best = end.score;
      most_probable = {direction, end.node, end.score};
    }
  }
  return most_probable;
}

// Adds the odds of the ends [first, last) of a direction.
void AddOdds(const RelativeAlignment& alignment, Direction direction,
             std::size_t first, std::size_t last, OddsByScale* sum) {
  const ScoredEnds& ends = alignment.ends(direction);
  const std::vector<double>& odds = alignment.odds_by_scale(direction);
  for (std::size_t i = first; i < last; ++i) {
    sum->Add(&odds[i * kScales], ends[i].nodes);
  }
}

}  // namespace

absl::StatusOr<MarkEvidence> SearchMark(const SearchTask& task) {
  RelativeModel model = ModelOf(task, kPrunedMarkShare);
  model.last_confirmed.reset();
  model.over_loops = false;
  model.scales = DriveBelief().AllScales();
  model.tell_scales = true;
  MarkEvidence evidence;
  evidence.node = task.query.node;
  OddsByScale own;
  OddsByScale all;
  OddsByScale near;
  double best = kImpossible;
  const bool finished = VisitAlignments(
      task, model, ModelAcross(model), PassedOver(),
      [&](const History& history, const RelativeAlignment& alignment) {
        for (const Direction direction : Directions(task.options.direction)) {
          const std::size_t ends = alignment.ends(direction).size();
          AddOdds(alignment, direction, 0, ends, &all);
        }
        // The own recording comes first.
        if (history.relation.is_own()) own = all;
        const auto end = MostProbable(alignment, task.options.direction);
        if (!end || !(end->score > best)) return;
        best = end->score;
        evidence.matched = end->node;
        const EndsAround around = FindEndsAround(
            alignment.ends(end->direction), end->node, [&](NodeIndex i) {
              return history.graph.MetersApart(i, end->node) <=
                     kMatchRadiusMeters;
            });
        near = OddsByScale();
        AddOdds(alignment, end->direction, around.first, around.last, &near);
      });
  if (!finished) return StoppedError();
  for (std::size_t k = 0; k < kScales; ++k) {
    evidence.log_evidence[k] = LogAdd(0.0, own[k]);
    evidence.log_all_evidence[k] = LogAdd(0.0, all[k]);
    evidence.log_matched_odds[k] = near[k];
  }
  return evidence;
}

}  // namespace revisit::core
