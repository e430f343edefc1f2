#include "core/engine.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "absl/status/status.h"
#include "core/candidates/ranking.h"

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

// A node this fraction of a check interval before a multiple of it counts as
// there: multiples of spacing and interval are rounded differently.
constexpr double kCheckTolerance = 1e-9;

}  // namespace

Engine::Engine(const EngineSettings& settings)
    : settings_(settings), resampler_(MakeResamplerOptions(settings)) {
  assert(FindProblems(settings).empty());
  ScheduleNextCheck();
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
  settings_ = settings;
  revision_ = revision;
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
  }
  revision_ = revision;
}

void Engine::RemoveLoopClosure(std::uint64_t query_sequence,
                               std::uint64_t matched_sequence,
                               std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto edge = LoopEdge(query_sequence, matched_sequence)) {
    graph_.RemoveLoopEdge(edge->first, edge->second);
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
  UpdateConsistency();
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
  UpdateConsistency();
}

void Engine::UpdateConsistency() {
  consistency_.rejected = static_cast<std::int64_t>(rejected_.size());
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

  SimilarityModel model;
  model.state_space = settings_.state_space;
  model.correlation = options.correlation_model;
  model.form = options.likelihood_form;
  model.tolerance = options.place_tolerance;
  const std::optional<Alignment> alignment =
      Align(graph_, model, query, steps, history_size, should_stop);
  if (!alignment) return absl::CancelledError("the search was told to stop");
  set.nodes_considered = history_size;

  const Gate gate(settings_.state_space, options.gate_probability);
  for (const RankedEnd& end :
       RankEnds(graph_, *alignment, query, options.candidate_separation_meters,
                options.max_candidates)) {
    Candidate candidate;
    candidate.rank = static_cast<int>(set.candidates.size()) + 1;
    candidate.score = end.score;
    candidate.matched = end.matched;
    candidate.difference = DecideAt(graph_, model, gate, query, end.matched);
    NodeIndex recent = query - steps + 1;
    for (NodeIndex matched : alignment->Path(end.matched)) {
      candidate.path.emplace_back(recent++, matched);
    }
    set.candidates.push_back(std::move(candidate));
  }
  if (set.candidates.empty()) return empty(EmptyReason::kNoAlignment);
  return set;
}

}  // namespace revisit::core
