#include "core/search/candidates/relative_search.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/chance.h"
#include "core/search/alignment/far_histories.h"
#include "core/search/alignment/relative.h"
#include "core/search/candidates/gate.h"
#include "core/search/candidates/posterior.h"
#include "core/search/candidates/ranking.h"
#include "core/search/candidates/rivals.h"
#include "core/search/candidates/verdict.h"
#include "core/settings.h"

namespace revisit::core {
namespace {

// Places of each direction that are ranked at first, or as many as are answered
// if these are more. Four times as many are while those that are left out would
// still have this share of the probability: passes of a road that was driven
// often.
constexpr int kRankedFirst = 16;
constexpr double kMostLeftOut = 0.01;
// Once so many are ranked, no more are.
constexpr int kMostRanked = 4096;

class RelativeSearch {
 public:
  // `prune`: whether improbable ends are left out.
  RelativeSearch(const SearchTask& task, bool prune)
      : task_(task),
        options_(task.options),
        // Small enough that no end which is left out could be accepted.
        pruned_share_(prune ? std::min(kPrunedShare,
                                       1e-3 * options_.acceptance_probability)
                            : 0.0),
        model_(ModelOf(task, pruned_share_)),
        across_(ModelAcross(model_)),
        passed_over_(FindFar(task, across_)) {}

  absl::Status Run(CandidateSet* set) {
    set->comparisons = Comparisons();
    if (task_.comparisons != nullptr) *task_.comparisons = set->comparisons;
    if (set->comparisons > options_.max_comparisons) {
      set->empty_reason = EmptyReason::kTooMuchWork;
      return absl::OkStatus();
    }
    if (!Align()) return StoppedError();
    set->nodes_considered = 0;
    for (const RelativeAlignment& alignment : alignments_) {
      set->nodes_considered += alignment.considered();
    }
    set->nodes_pruned = task_.history_size() - set->nodes_considered;
    int most = std::max(options_.max_candidates, kRankedFirst);
    std::vector<RankedPlace> places = Rank(most);
    // There are no odds where no covariance is well-conditioned.
    if (places.empty() && set->nodes_pruned == 0) return absl::OkStatus();
    double new_place = Claim(&places);
    while (LeftOut(places, new_place) > kMostLeftOut && most < kMostRanked) {
      most *= 4;
      places = Rank(most);
      new_place = Claim(&places);
    }
    Rivals rivals(task_.histories, task_.frames.get(), model_,
                  std::move(places),
                  static_cast<std::size_t>(options_.max_candidates));
    // One drive's own passes of a place are few.
    if (task_.histories.size() > 1) {
      new_place = rivals.AverageOverPasses(task_.histories, new_place);
    }
    set->new_place_probability = new_place;
    set->candidates = Judge(rivals, new_place);
    return absl::OkStatus();
  }

  // Whether any verdict might be another if nothing had been pruned: what was
  // left out would take away at most the pruned share, or add as much.
  bool IsUndecided(const CandidateSet& set) const {
    return std::any_of(set.candidates.begin(), set.candidates.end(),
                       [&](const Candidate& candidate) {
                         return std::abs(candidate.relative->probability -
                                         options_.acceptance_probability) <=
                                2.0 * pruned_share_;
                       });
  }

 private:
  // Counts the comparisons without those of histories that are passed over.
  std::int64_t Comparisons() const {
    NodeIndex nodes = 0;
    for (std::size_t h = 0; h < task_.histories.size(); ++h) {
      const History& history = task_.histories[h];
      if (history.drive && !passed_over_.Has(h)) nodes += history.size();
    }
    return task_.own_comparisons +
           nodes * task_.across.steps *
               static_cast<std::int64_t>(Directions(options_.direction).size());
  }

  // Aligns the query with one history after the other; alignments do not depend
  // on each other. False if told to stop.
  bool Align() {
    WeighChance();
    return VisitAlignments(task_, model_, across_, passed_over_,
                           [this](const History&, RelativeAlignment found) {
                             alignments_.push_back(std::move(found));
                           });
  }

  // Lets what other recordings match by chance count, where other drives are
  // searched: recordings of one drive whose frames are known exactly are as one
  // recording. The alignments take over the recent path.
  void WeighChance() {
    const std::vector<History>& histories = task_.histories;
    const auto other = std::find_if(
        histories.begin(), histories.end(),
        [](const History& history) { return history.drive.has_value(); });
    if (other == histories.end()) return;
    AlignmentParts none;
    AlignmentParts& parts = task_.parts == nullptr
                                ? none
                                : (*task_.parts)[static_cast<std::size_t>(
                                      other - histories.begin())];
    if (parts.path == nullptr) parts.path = passed_over_.path.path;
    across_.log_chance =
        MeasureChance(task_.across, histories, across_, &parts).log_odds();
  }

  const ShapeMatch& MatchOf(const RankedPlace& place) const {
    return alignments_[place.history].match(place.direction, place.end.matched);
  }
  const History& HistoryOf(const RankedPlace& place) const {
    return task_.histories[place.history];
  }

  // Best score first; of equal scores, the first history first, and the same
  // direction first. Claim() gives nodes that several places could claim to the
  // first of them.
  std::vector<RankedPlace> Rank(int most_of_direction) const {
    std::vector<RankedPlace> places;
    for (std::size_t h = 0; h < alignments_.size(); ++h) {
      for (const Direction direction : Directions(options_.direction)) {
        for (const RankedEnd& end : RankEnds(
                 task_.histories[h].graph, alignments_[h].ends(direction),
                 options_.candidate_separation_meters, most_of_direction)) {
          places.push_back({h, direction, end});
          places.back().log_likelihood_ratio =
              MatchOf(places.back()).log_likelihood_ratio;
        }
      }
    }
    std::stable_sort(places.begin(), places.end(),
                     [](const RankedPlace& a, const RankedPlace& b) {
                       return a.end.score > b.end.score;
                     });
    return places;
  }

  // Lets each place claim its nodes, the best place first. Returns the
  // probability of a new place.
  double Claim(std::vector<RankedPlace>* places) const {
    std::vector<LogOdds> log_odds;
    for (std::size_t h = 0; h < alignments_.size(); ++h) {
      log_odds.push_back({task_.histories[h].graph,
                          {alignments_[h].ends(Direction::kSame),
                           alignments_[h].ends(Direction::kOpposite)}});
    }
    Posterior posterior(
        std::move(log_odds),
        StretchRadiusMeters(model_.similarity.correlation.noise()));
    for (RankedPlace& place : *places) {
      const Posterior::Stretch stretch =
          posterior.Claim(place.history, place.direction, place.end.matched);
      place.claimed = stretch.probability;
      place.first = stretch.first;
      place.last = stretch.last;
    }
    return posterior.new_place();
  }

  // The probability of the places that were not ranked.
  static double LeftOut(const std::vector<RankedPlace>& places,
                        double new_place) {
    double left = 1.0 - new_place;
    for (const RankedPlace& place : places) left -= place.claimed;
    return left;
  }

  // The best places as candidates. The others have counted as rivals.
  std::vector<Candidate> Judge(const Rivals& rivals, double new_place) const {
    const std::size_t answered =
        std::min(rivals.places().size(),
                 static_cast<std::size_t>(options_.max_candidates));
    const Gate gate(model_.similarity.state_space, options_.gate_probability);
    std::vector<Candidate> candidates;
    for (std::size_t i = 0; i < answered; ++i) {
      candidates.push_back(MakeCandidate(gate, rivals, i, new_place));
    }
    return candidates;
  }

  Candidate MakeCandidate(const Gate& gate, const Rivals& rivals, std::size_t i,
                          double new_place) const {
    const RankedPlace& place = rivals.places()[i];
    SimilarityModel similarity = model_.similarity;
    similarity.direction = place.direction;
    similarity.inflation *= MatchOf(place).scale;
    Candidate candidate;
    candidate.score = place.end.score;
    candidate.drive = HistoryOf(place).drive;
    candidate.matched = place.end.matched;
    const Relation& relation = HistoryOf(place).relation;
    if (!relation.is_own()) candidate.frame_state = relation.state();
    candidate.direction = place.direction;
    candidate.inflation = similarity.inflation;
    candidate.difference =
        DecideAt(task_.query, HistoryOf(place), similarity, gate,
                 place.end.matched, MatchOf(place).way);
    const double runner_up = rivals.RunnerUp(i);
    RelativeEvidence evidence =
        EvidenceOf(gate, place, candidate.difference.has_value());
    evidence.probability = rivals.Probability(i);
    if (runner_up > 0.0) {
      evidence.odds_to_runner_up = evidence.probability / runner_up;
    }
    candidate.verdict = Decide(
        candidate.difference ? &candidate.difference->gate : nullptr, evidence,
        {runner_up, new_place}, options_.acceptance_probability);
    candidate.relative = evidence;
    if (options_.tell_paths) candidate.path = PathOf(place);
    return candidate;
  }

  // The evidence that the alignment alone has for a place. Where the difference
  // at the end is not known, the shape alone is tested.
  RelativeEvidence EvidenceOf(const Gate& gate, const RankedPlace& place,
                              bool has_difference) const {
    const ShapeMatch& match = MatchOf(place);
    const PoseGraph& graph = HistoryOf(place).graph;
    const double weight = ShapeWeight(model_.shape, model_.spacing_meters);
    const int dimensions = DegreesOfFreedom(model_.similarity.state_space);
    RelativeEvidence evidence;
    evidence.path_gate = gate.DecidePath(
        match.squared_end_difference + weight * match.squared_innovations,
        has_difference
            ? dimensions * (1.0 + weight * static_cast<double>(match.steps))
            : dimensions * weight *
                  std::max(1.0, static_cast<double>(match.steps)));
    evidence.squared_end_difference = match.squared_end_difference;
    evidence.overlap_meters =
        static_cast<double>(match.steps) * model_.spacing_meters;
    evidence.log_likelihood_ratio = match.log_likelihood_ratio;
    evidence.meters_before = graph.MetersApart(place.first, place.end.matched);
    evidence.meters_after = graph.MetersApart(place.last, place.end.matched);
    return evidence;
  }

  std::vector<std::pair<NodeIndex, NodeIndex>> PathOf(
      const RankedPlace& place) const {
    std::vector<std::pair<NodeIndex, NodeIndex>> path;
    for (const PathStep& step :
         alignments_[place.history].Path(place.direction, place.end.matched)) {
      path.emplace_back(task_.query.node - step.t, step.node);
    }
    std::reverse(path.begin(), path.end());
    return path;
  }

  const SearchTask& task_;
  const SearchOptions& options_;
  const double pruned_share_;
  const RelativeModel model_;
  // The same for other recordings.
  RelativeModel across_;
  const PassedOver passed_over_;
  // One for each history.
  std::vector<RelativeAlignment> alignments_;
};

}  // namespace

RelativeModel ModelOf(const SearchTask& task, double pruned_share) {
  const SearchOptions& options = task.options;
  RelativeModel model;
  model.similarity = task.prior.similarity;
  model.shape = options.shape;
  model.spacing_meters = task.node_spacing_meters;
  model.road_spacing_meters = options.road_spacing_meters;
  model.same_direction = options.direction != SearchDirection::kOpposite;
  model.opposite_direction = options.direction != SearchDirection::kSame;
  if (model.similarity.correlation.noise().closures_show_drift) {
    model.last_confirmed = task.prior.last_confirmed;
  }
  if (task.prior.belief) {
    model.scales = task.prior.belief->Scales();
    model.drifts = task.prior.belief->drifts(task.recording);
  }
  if (pruned_share > 0.0) {
    const double ends =
        (model.same_direction && model.opposite_direction ? 2.0 : 1.0) *
        static_cast<double>(task.history_size());
    model.least_log_share = std::log(pruned_share / ends);
    model.most_log_odds_sampled = kMostLogOddsSampled;
  }
  return model;
}

RelativeModel ModelAcross(const RelativeModel& model) {
  RelativeModel across = model;
  across.last_confirmed.reset();
  across.drifts.clear();
  return across;
}

PassedOver FindFar(const SearchTask& task, const RelativeModel& across) {
  PassedOver passed_over;
  std::optional<FarHistories> far;
  for (std::size_t h = 0; h < task.histories.size(); ++h) {
    const History& history = task.histories[h];
    if (history.extents == nullptr) continue;
    if (!far) {
      far.emplace(task.QueryIn(history), across, &passed_over.path);
      passed_over.are_far.resize(task.histories.size());
    }
    passed_over.are_far[h] = far->Has(history) ? 1 : 0;
  }
  return passed_over;
}

bool VisitAlignments(
    const SearchTask& task, const RelativeModel& model,
    const RelativeModel& across, const PassedOver& passed_over,
    const std::function<void(const History&, RelativeAlignment)>& visit) {
  std::shared_ptr<const void> path = passed_over.path.path;
  for (std::size_t h = 0; h < task.histories.size(); ++h) {
    const History& history = task.histories[h];
    if (passed_over.Has(h)) {
      visit(history, RelativeAlignment());
      continue;
    }
    AlignmentParts own_parts;
    AlignmentParts& parts =
        task.parts == nullptr ? own_parts : (*task.parts)[h];
    const bool is_own = history.relation.is_own();
    if (!is_own && parts.path == nullptr) parts.path = path;
    std::optional<RelativeAlignment> alignment =
        AlignRelative(task.QueryIn(history), history, is_own ? model : across,
                      task.should_stop, &parts);
    if (!alignment) return false;
    if (!is_own) path = parts.path;
    visit(history, *std::move(alignment));
  }
  return true;
}

absl::Status SearchRelative(const SearchTask& task, CandidateSet* set) {
  if (!task.options.exhaustive) {
    RelativeSearch search(task, /*prune=*/true);
    CandidateSet found = *set;
    const absl::Status status = search.Run(&found);
    if (!status.ok()) return status;
    if (!search.IsUndecided(found)) {
      *set = std::move(found);
      return absl::OkStatus();
    }
  }
  return RelativeSearch(task, /*prune=*/false).Run(set);
}

}  // namespace revisit::core
