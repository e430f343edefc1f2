#include "core/engine.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>

#include "absl/status/status.h"
#include "core/alignment/relative.h"
#include "core/candidates/posterior.h"
#include "core/candidates/ranking.h"
#include "core/candidates/same_place.h"

namespace revisit::core {
namespace {

ResamplerOptions MakeResamplerOptions(const EngineSettings& settings) {
  ResamplerOptions options;
  options.state_space = settings.state_space;
  options.spacing_meters = settings.node_spacing_meters;
  options.max_step_meters = settings.max_step_meters;
  options.carry_transitions =
      settings.search.correlation_model == CorrelationModel::kFilter;
  return options;
}

// Without inflation.
SimilarityModel ClaimedModel(StateSpace space, const SearchOptions& options) {
  SimilarityModel model;
  model.state_space = space;
  model.correlation = options.correlation_model;
  model.form = options.likelihood_form;
  model.tolerance = options.place_tolerance;
  return model;
}

ConsistencyOptions MakeConsistencyOptions(const EngineSettings& settings) {
  ConsistencyOptions options;
  options.similarity = ClaimedModel(settings.state_space, settings.search);
  options.gate_probability = settings.search.gate_probability;
  options.applied = settings.apply_inflation;
  options.max_inflation = settings.max_inflation;
  return options;
}

// A node this fraction of a check interval before a multiple of it counts as
// there: multiples of spacing and interval are rounded differently.
constexpr double kCheckTolerance = 1e-9;

std::vector<Direction> Directions(SearchDirection direction) {
  switch (direction) {
    case SearchDirection::kSame:
      return {Direction::kSame};
    case SearchDirection::kOpposite:
      return {Direction::kOpposite};
    case SearchDirection::kEither:
      break;
  }
  return {Direction::kSame, Direction::kOpposite};
}

// Share of all odds, a new place's 1 among them, that a search may leave out,
// all ends together.
constexpr double kPrunedShare = 1e-6;

absl::Status Stopped() {
  return absl::CancelledError("the search was told to stop");
}

// An end that was ranked, and what it may claim for itself.
struct RankedPlace {
  Direction direction;
  RankedEnd end;
  double claimed = 0.0;
  // With all other passes of the same place.
  double probability = 0.0;
};

// Places more probable than this are weighed against each other.
constexpr double kLeastRivalProbability = 1e-3;
constexpr int kMostRivals = 16;

// A candidate this many times less probable than another is not "about as
// good".
constexpr double kAmbiguousOdds = 10.0;

Verdict GateAlone(GateVerdict gate) {
  switch (gate) {
    case GateVerdict::kAccepted:
      return Verdict::kAccepted;
    case GateVerdict::kRejected:
      return Verdict::kRejectedByGate;
    case GateVerdict::kIllConditioned:
      break;
  }
  return Verdict::kIllConditioned;
}

Verdict Decide(const GateResult& gate, const RelativeEvidence& evidence,
               double runner_up, double new_place,
               double acceptance_probability) {
  // One noisy pose at the end does not count against what the path tells.
  const bool outside = gate.verdict == GateVerdict::kRejected &&
                       evidence.squared_end_difference > gate.threshold;
  if (outside || gate.verdict == GateVerdict::kIllConditioned) {
    return GateAlone(gate.verdict);
  }
  if (evidence.path_gate.verdict == GateVerdict::kRejected) {
    return Verdict::kRejectedByShape;
  }
  const double here = evidence.probability;
  if (here >= acceptance_probability) return Verdict::kAccepted;
  if (1.0 - new_place >= acceptance_probability) {
    // It is somewhere in the history.
    return runner_up < acceptance_probability &&
                   here * kAmbiguousOdds >= runner_up
               ? Verdict::kAmbiguous
               : Verdict::kRejectedByShape;
  }
  // Had the two ends coincided, with the same shape.
  const double at_best = here * std::exp(0.5 * evidence.squared_end_difference);
  const double total = 1.0 - here + at_best;
  if (at_best < acceptance_probability * total) {
    return Verdict::kUninformative;
  }
  return Verdict::kRejectedByShape;
}

// Of those found in either direction; ties keep their order.
void KeepBest(int count, std::vector<Candidate>* candidates) {
  std::stable_sort(
      candidates->begin(), candidates->end(),
      [](const Candidate& a, const Candidate& b) { return a.score > b.score; });
  if (candidates->size() > static_cast<std::size_t>(count)) {
    candidates->resize(static_cast<std::size_t>(count));
  }
}

}  // namespace

Engine::Engine(const EngineSettings& settings)
    : settings_(settings),
      resampler_(MakeResamplerOptions(settings)),
      motion_history_(MakeMotionHistory()),
      block_bounds_(settings.state_space),
      monitor_(MakeConsistencyOptions(settings)) {
  assert(FindProblems(settings).empty());
  ScheduleNextCheck();
}

MotionHistory Engine::MakeMotionHistory() const {
  const SearchOptions& search = settings_.search;
  return MotionHistory(
      settings_.state_space, search.correlation_model,
      StretchNodes(search.shape, settings_.node_spacing_meters,
                   SequenceNodes(search.sequence_length_meters,
                                 settings_.node_spacing_meters)));
}

// Under kFilter a search goes through all nodes whatever there is, and they
// take the most memory: it does without.
void Engine::ExtendIndexes() {
  if (settings_.search.correlation_model == CorrelationModel::kFilter) return;
  motion_history_.Extend(graph_);
  block_bounds_.Extend(graph_);
}

// The first check that lies after all nodes there are and leaves room for the
// sequence and as much history.
void Engine::ScheduleNextCheck() {
  const double interval = settings_.check_interval_meters;
  const double first =
      std::ceil(2.0 * settings_.search.sequence_length_meters / interval -
                kCheckTolerance);
  const double next =
      graph_.size() == 0
          ? 0.0
          : std::floor(graph_.node(graph_.size() - 1).travelled_meters /
                           interval +
                       kCheckTolerance) +
                1.0;
  next_check_ = static_cast<std::int64_t>(std::max(first, next));
}

AppendResult Engine::Append(const std::vector<PoseSample>& samples,
                            std::uint64_t revision) {
  assert(revision > revision_);
  AppendResult result;
  for (const PoseSample& sample : samples) {
    assert(sample.sequence == last_sequence_ + 1);
    const NodeIndex before = graph_.size();
    if (std::optional<Jump> jump = resampler_.Add(sample, &graph_)) {
      result.jumps.push_back(*jump);
    }
    for (NodeIndex i = before; i < graph_.size(); ++i) {
      const double due = (static_cast<double>(next_check_) - kCheckTolerance) *
                         settings_.check_interval_meters;
      if (graph_.node(i).travelled_meters >= due) {
        result.checks_due.push_back(i);
        ++next_check_;
      }
    }
    last_sequence_ = sample.sequence;
  }
  ExtendIndexes();
  revision_ = revision;
  return result;
}

void Engine::ChangeSettings(const EngineSettings& settings,
                            std::uint64_t revision) {
  assert(revision > revision_);
  assert(FindProblems(settings).empty());
  assert(settings.state_space == settings_.state_space &&
         settings.node_spacing_meters == settings_.node_spacing_meters &&
         settings.max_step_meters == settings_.max_step_meters);
  const bool monitored_alike =
      MakeConsistencyOptions(settings) == MakeConsistencyOptions(settings_);
  settings_ = settings;
  revision_ = revision;
  if (!monitored_alike) RebuildMonitor();
  motion_history_ = MakeMotionHistory();
  ExtendIndexes();
  ScheduleNextCheck();
}

std::optional<std::pair<NodeIndex, NodeIndex>> Engine::LoopEdge(
    std::uint64_t query_sequence, std::uint64_t matched_sequence) const {
  const std::optional<NodeIndex> query = graph_.NodeAtOrBefore(query_sequence);
  const std::optional<NodeIndex> matched =
      graph_.NodeAtOrBefore(matched_sequence);
  if (!query || !matched || *query == *matched) return std::nullopt;
  return std::make_pair(*query, *matched);
}

void Engine::AddLoopClosure(std::uint64_t query_sequence,
                            std::uint64_t matched_sequence,
                            std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto edge = LoopEdge(query_sequence, matched_sequence)) {
    graph_.AddLoopEdge(edge->first, edge->second);
    confirmed_.push_back(
        {query_sequence, matched_sequence, {edge->first, edge->second}});
    monitor_.Confirm(graph_, confirmed_.back().loop);
  }
  revision_ = revision;
}

void Engine::RemoveLoopClosure(std::uint64_t query_sequence,
                               std::uint64_t matched_sequence,
                               std::uint64_t revision, std::size_t occurrence) {
  assert(revision > revision_);
  for (auto it = confirmed_.begin(); it != confirmed_.end(); ++it) {
    if (it->query_sequence != query_sequence ||
        it->matched_sequence != matched_sequence || occurrence-- > 0) {
      continue;
    }
    graph_.RemoveLoopEdge(it->loop.query, it->loop.matched);
    confirmed_.erase(it);
    RebuildMonitor();
    break;
  }
  revision_ = revision;
}

void Engine::AddRejection(std::uint64_t query_sequence,
                          std::uint64_t matched_sequence,
                          std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto pair = LoopEdge(query_sequence, matched_sequence)) {
    rejected_.push_back(*pair);
  }
  revision_ = revision;
}

void Engine::RemoveRejection(std::uint64_t query_sequence,
                             std::uint64_t matched_sequence,
                             std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto pair = LoopEdge(query_sequence, matched_sequence)) {
    const auto found = std::find(rejected_.begin(), rejected_.end(), *pair);
    if (found != rejected_.end()) rejected_.erase(found);
  }
  revision_ = revision;
}

Consistency Engine::consistency() const {
  Consistency consistency = monitor_.consistency();
  consistency.rejected = static_cast<std::int64_t>(rejected_.size());
  return consistency;
}

void Engine::RebuildMonitor() {
  monitor_ = ConsistencyMonitor(MakeConsistencyOptions(settings_));
  for (const Confirmed& confirmed : confirmed_) {
    monitor_.Confirm(graph_, confirmed.loop);
  }
}

absl::StatusOr<CandidateSet> Engine::FindCandidates(
    const SearchOptions& options, const ShouldStop& should_stop) const {
  if (graph_.size() == 0) {
    CandidateSet empty;
    empty.empty_reason = EmptyReason::kPathTooShort;
    return empty;
  }
  return FindCandidates(graph_.size() - 1, options, should_stop);
}

absl::StatusOr<CandidateSet> Engine::FindCandidates(
    NodeIndex query, const SearchOptions& options,
    const ShouldStop& should_stop) const {
  assert(query >= 0 && query < graph_.size());
  assert(FindProblems(options, settings_).empty());
  CandidateSet set;
  set.query = query;
  const auto empty = [&set](EmptyReason reason) {
    set.empty_reason = reason;
    return set;
  };

  const std::int64_t steps = SequenceNodes(options.sequence_length_meters,
                                           settings_.node_spacing_meters);
  if (query - graph_.SegmentStart(query) + 1 < steps) {
    return empty(EmptyReason::kPathTooShort);
  }
  // Eq. 5: the graph without the nodes of the sequence.
  const NodeIndex history_size = query - steps + 1;
  if (history_size == 0) return empty(EmptyReason::kNoHistory);
  if (graph_.node(query).travelled_meters - graph_.node(0).travelled_meters <
      options.candidate_separation_meters) {
    return empty(EmptyReason::kAllSuppressed);
  }

  set.comparisons =
      steps * history_size *
      static_cast<std::int64_t>(Directions(options.direction).size());
  if (set.comparisons > options.max_comparisons) {
    return empty(EmptyReason::kTooMuchWork);
  }
  set.nodes_considered = history_size;
  set.inflation = MakeSimilarityModel(options).inflation;
  absl::Status status;
  if (options.alignment == AlignmentKind::kComposite) {
    status =
        FindComposite(query, steps, history_size, options, should_stop, &set);
  } else {
    bool undecided = options.exhaustive;
    CandidateSet found = set;
    if (!options.exhaustive) {
      status = FindRelative(query, steps, history_size, options, should_stop,
                            &found, &undecided);
    }
    if (status.ok() && undecided) {
      found = set;
      status = FindRelative(query, steps, history_size, options, should_stop,
                            &found, nullptr);
    }
    set = std::move(found);
  }
  if (!status.ok()) return status;
  for (std::size_t i = 0; i < set.candidates.size(); ++i) {
    set.candidates[i].rank = static_cast<int>(i) + 1;
  }
  if (set.candidates.empty()) {
    return empty(set.nodes_pruned > 0 ? EmptyReason::kNoProbablePlace
                                      : EmptyReason::kNoAlignment);
  }
  return set;
}

std::optional<ConfirmedLoop> Engine::LastConfirmed(NodeIndex query) const {
  std::optional<ConfirmedLoop> last;
  for (const auto& [query_sequence, matched_sequence, loop] : confirmed_) {
    const NodeIndex later = std::max(loop.query, loop.matched);
    if (later > query) continue;
    if (!last || later >= std::max(last->query, last->matched)) last = loop;
  }
  return last;
}

SimilarityModel Engine::MakeSimilarityModel(
    const SearchOptions& options) const {
  SimilarityModel model = ClaimedModel(settings_.state_space, options);
  if (settings_.apply_inflation) {
    model.inflation = monitor_.consistency().inflation;
  }
  return model;
}

std::vector<NodeRange> Engine::NotSought(NodeIndex query,
                                         double separation_meters) const {
  std::vector<NodeRange> nodes = {
      NodesNearer(graph_, query, separation_meters)};
  // A hair more, so that what lies just as far is struck out too.
  const double around =
      std::max(separation_meters, kPlaceRadiusMeters) * (1.0 + 1e-9);
  for (const auto& [rejected_query, rejected_match] : rejected_) {
    if (graph_.MetersApart(rejected_query, query) <= around) {
      nodes.push_back(NodesNearer(graph_, rejected_match, around));
    }
  }
  return nodes;
}

absl::Status Engine::FindComposite(NodeIndex query, std::int64_t steps,
                                   NodeIndex history_size,
                                   const SearchOptions& options,
                                   const ShouldStop& should_stop,
                                   CandidateSet* set) const {
  const Gate gate(settings_.state_space, options.gate_probability);
  const std::vector<NodeRange> not_sought =
      NotSought(query, options.candidate_separation_meters);
  for (const Direction direction : Directions(options.direction)) {
    SimilarityModel model = MakeSimilarityModel(options);
    model.direction = direction;
    const std::optional<Alignment> alignment =
        Align(graph_, model, query, steps, history_size, should_stop);
    if (!alignment) return Stopped();
    ScoredEnds ends = PossibleEnds(alignment->scores());
    for (const NodeRange& nodes : not_sought) StrikeOut(nodes, &ends);
    for (const RankedEnd& end :
         RankEnds(graph_, ends, options.candidate_separation_meters,
                  options.max_candidates)) {
      Candidate candidate;
      candidate.score = end.score;
      candidate.matched = end.matched;
      candidate.direction = direction;
      candidate.difference = DecideAt(graph_, model, gate, query, end.matched);
      candidate.verdict = GateAlone(candidate.difference.gate.verdict);
      if (options.tell_paths) {
        NodeIndex recent = query - steps + 1;
        for (NodeIndex matched : alignment->Path(end.matched)) {
          candidate.path.emplace_back(recent++, matched);
        }
      }
      set->candidates.push_back(std::move(candidate));
    }
  }
  KeepBest(options.max_candidates, &set->candidates);
  return absl::OkStatus();
}

absl::Status Engine::FindRelative(NodeIndex query, std::int64_t steps,
                                  NodeIndex history_size,
                                  const SearchOptions& options,
                                  const ShouldStop& should_stop,
                                  CandidateSet* set, bool* undecided) const {
  RelativeModel model;
  model.similarity = MakeSimilarityModel(options);
  model.shape = options.shape;
  model.spacing_meters = settings_.node_spacing_meters;
  model.road_spacing_meters = options.road_spacing_meters;
  model.same_direction = options.direction != SearchDirection::kOpposite;
  model.opposite_direction = options.direction != SearchDirection::kSame;
  if (model.similarity.correlation == CorrelationModel::kDeadReckoning) {
    model.last_confirmed = LastConfirmed(query);
  }
  model.not_sought = NotSought(query, options.candidate_separation_meters);
  model.motion_history = &motion_history_;
  // So little that no end with less can be accepted.
  const double pruned_share =
      std::min(kPrunedShare, 1e-3 * options.acceptance_probability);
  if (undecided != nullptr) {
    const double ends =
        (model.same_direction && model.opposite_direction ? 2.0 : 1.0) *
        static_cast<double>(history_size);
    model.least_log_share = std::log(pruned_share / ends);
    model.block_bounds = &block_bounds_;
  }
  const std::optional<RelativeAlignment> alignment =
      AlignRelative(graph_, model, query, steps, history_size, should_stop);
  if (!alignment) return Stopped();
  set->nodes_considered = alignment->considered();
  set->nodes_pruned = history_size - alignment->considered();

  std::array<ScoredEnds, 2> log_odds = {alignment->ends(Direction::kSame),
                                        alignment->ends(Direction::kOpposite)};
  // Best first; of equal scores, the same direction first.
  std::vector<RankedPlace> places;
  for (const Direction direction : Directions(options.direction)) {
    for (const RankedEnd& end :
         RankEnds(graph_, log_odds[IndexOf(direction)],
                  options.candidate_separation_meters,
                  std::max(options.max_candidates, kMostRivals))) {
      places.push_back({direction, end});
    }
  }
  std::stable_sort(places.begin(), places.end(),
                   [](const RankedPlace& a, const RankedPlace& b) {
                     return a.end.score > b.end.score;
                   });
  // Nothing can be said where no covariance is well-conditioned.
  if (places.empty() && set->nodes_pruned == 0) return absl::OkStatus();
  Posterior posterior(graph_, std::move(log_odds));
  set->new_place_probability = posterior.new_place();
  for (RankedPlace& place : places) {
    place.claimed = posterior.Claim(place.direction, place.end.matched);
  }
  const auto match_of = [&](const RankedPlace& place) -> const ShapeMatch& {
    return alignment->match(place.direction, place.end.matched);
  };
  // Whether two are passes of one place, found once for each two. What is
  // improbable is not asked about.
  std::vector<double> same_place(places.size() * places.size());
  const auto same = [&](std::size_t i, std::size_t j) -> double& {
    return same_place[i * places.size() + j];
  };
  for (std::size_t i = 0; i < places.size(); ++i) {
    for (std::size_t j = 0; j < places.size(); ++j) {
      const RankedPlace& a = places[i];
      const RankedPlace& b = places[j];
      if (i == j) {
        same(i, j) = 1.0;
      } else if (a.direction == b.direction &&
                 b.claimed >= kLeastRivalProbability) {
        same(i, j) =
            SamePlaceProbability(graph_, model, a.end.matched, b.end.matched,
                                 std::min(match_of(a).log_likelihood_ratio,
                                          match_of(b).log_likelihood_ratio));
      }
    }
  }
  for (std::size_t i = 0; i < places.size(); ++i) {
    RankedPlace& place = places[i];
    // The best end of a stretch stands for all of it.
    const bool stands = std::none_of(
        places.begin(), places.begin() + static_cast<int>(i),
        [&](const RankedPlace& better) {
          return better.direction == place.direction &&
                 graph_.MetersApart(better.end.matched, place.end.matched) <=
                     2.0 * kPlaceRadiusMeters;
        });
    place.probability = place.claimed;
    for (std::size_t j = 0; j < places.size(); ++j) {
      if (stands && j != i) place.probability += same(i, j) * places[j].claimed;
    }
    place.probability = std::min(place.probability, 1.0);
  }

  const Gate gate(settings_.state_space, options.gate_probability);
  const double weight = ShapeWeight(model.shape, model.spacing_meters);
  const int dimensions = DegreesOfFreedom(settings_.state_space);
  // Those that are not answered have counted as rivals.
  const std::size_t answered =
      std::min(places.size(), static_cast<std::size_t>(options.max_candidates));
  for (std::size_t i = 0; i < answered; ++i) {
    const RankedPlace& place = places[i];
    SimilarityModel similarity = model.similarity;
    similarity.direction = place.direction;
    const NodeIndex matched = place.end.matched;
    const ShapeMatch& match = match_of(place);
    Candidate candidate;
    candidate.score = place.end.score;
    candidate.matched = matched;
    candidate.direction = place.direction;
    candidate.difference = DecideAt(graph_, similarity, gate, query, matched);

    RelativeEvidence evidence;
    evidence.probability = place.probability;
    double runner_up = 0.0;
    for (std::size_t j = 0; j < places.size(); ++j) {
      // What counts for the other because of this one does not count against
      // it.
      const double without = places[j].probability - same(j, i) * place.claimed;
      runner_up = std::max(runner_up, (1.0 - same(i, j)) * without);
    }
    if (runner_up > 0.0) {
      evidence.odds_to_runner_up = place.probability / runner_up;
    }
    evidence.path_gate = gate.DecidePath(
        match.squared_end_difference + weight * match.squared_innovations,
        dimensions * (1.0 + weight * static_cast<double>(match.steps)));
    evidence.squared_end_difference = match.squared_end_difference;
    evidence.overlap_meters =
        static_cast<double>(match.steps) * model.spacing_meters;
    evidence.log_likelihood_ratio = match.log_likelihood_ratio;
    candidate.verdict =
        Decide(candidate.difference.gate, evidence, runner_up,
               *set->new_place_probability, options.acceptance_probability);
    if (options.tell_paths) {
      for (const PathStep& step : alignment->Path(place.direction, matched)) {
        candidate.path.emplace_back(query - step.t, step.node);
      }
      std::reverse(candidate.path.begin(), candidate.path.end());
    }
    candidate.relative = evidence;
    set->candidates.push_back(std::move(candidate));
  }
  if (undecided != nullptr) {
    // What was left out would take away at most this share, or add as much.
    *undecided = std::any_of(
        set->candidates.begin(), set->candidates.end(),
        [&](const Candidate& candidate) {
          return std::abs(candidate.relative->probability -
                          options.acceptance_probability) <= 2.0 * pruned_share;
        });
  }
  return absl::OkStatus();
}

}  // namespace revisit::core
