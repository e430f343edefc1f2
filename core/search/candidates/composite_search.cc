#include "core/search/candidates/composite_search.h"

#include <cassert>
#include <optional>
#include <utility>

#include "core/drive/node_range.h"
#include "core/noise/similarity_model.h"
#include "core/search/candidates/gate.h"
#include "core/search/candidates/ranking.h"
#include "core/search/candidates/verdict.h"
#include "core/settings.h"

namespace revisit::core {
namespace {

Candidate MakeCandidate(const SearchTask& task, const SimilarityModel& model,
                        const Gate& gate, const Alignment& alignment,
                        const RankedEnd& end) {
  Candidate candidate;
  candidate.score = end.score;
  candidate.matched = end.matched;
  candidate.direction = model.direction;
  candidate.inflation = model.inflation;
  candidate.difference =
      DecideAt(task.query, task.histories.front(), model, gate, end.matched, 0);
  candidate.verdict = GateAlone(candidate.difference->gate.verdict);
  if (task.options.tell_paths) {
    NodeIndex recent = task.query.node - task.query.steps + 1;
    for (const NodeIndex matched : alignment.Path(end.matched)) {
      candidate.path.emplace_back(recent++, matched);
    }
  }
  return candidate;
}

}  // namespace

absl::Status SearchComposite(const SearchTask& task, CandidateSet* set) {
  assert(task.histories.size() == 1);
  const SearchOptions& options = task.options;
  const Query& query = task.query;
  const History& past = task.histories.front();
  const SimilarityModel& similarity = task.prior.similarity;
  const Gate gate(similarity.state_space, options.gate_probability);
  for (const Direction direction : Directions(options.direction)) {
    SimilarityModel model = similarity;
    model.direction = direction;
    const std::optional<Alignment> alignment =
        Align(query.graph, model, query.node, query.steps, past.end,
              task.should_stop);
    if (!alignment) return StoppedError();
    ScoredEnds ends = PossibleEnds(alignment->scores());
    StrikeOut({0, past.first}, &ends);
    for (const NodeRange& nodes : past.not_sought) StrikeOut(nodes, &ends);
    for (const RankedEnd& end :
         RankEnds(query.graph, ends, options.candidate_separation_meters,
                  options.max_candidates)) {
      set->candidates.push_back(
          MakeCandidate(task, model, gate, *alignment, end));
    }
  }
  KeepBest(options.max_candidates, &set->candidates);
  return absl::OkStatus();
}

}  // namespace revisit::core
