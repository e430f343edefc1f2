// The whole method behind one door: poses in, candidates out. No input or
// output, no clock, no threads: everything comes in as an argument.
//
// Thread-compatible: const calls may run at the same time, others need
// exclusion.
#ifndef REVISIT_CORE_ENGINE_H_
#define REVISIT_CORE_ENGINE_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/alignment/scored_ends.h"
#include "core/alignment/viterbi.h"
#include "core/candidates/consistency.h"
#include "core/candidates/gate.h"
#include "core/geometry/pose.h"
#include "core/graph/block_bounds.h"
#include "core/graph/distance_resampler.h"
#include "core/graph/motion_history.h"
#include "core/graph/pose_graph.h"
#include "core/settings.h"

namespace revisit::core {

// The first that applies, in the order of Decide() in the .cc.
enum class Verdict {
  kAccepted,
  kRejectedByGate,
  kRejectedByShape,
  kAmbiguous,
  kUninformative,
  kIllConditioned,
};

// What a relative alignment knows beyond the paper's.
struct RelativeEvidence {
  // Posterior of this place; over that of the best other place, if there is
  // one.
  double probability = 0.0;
  std::optional<double> odds_to_runner_up;
  GateResult path_gate;
  // ShapeMatch::squared_end_difference.
  double squared_end_difference = 0.0;
  // How far back the two run together, and ln of the likelihood ratio of their
  // shapes against another road's.
  double overlap_meters = 0.0;
  double log_likelihood_ratio = 0.0;
};

struct Candidate {
  // 1 for the best.
  int rank = 0;
  // Log-likelihood of the alignment less a constant.
  double score = 0.0;
  NodeIndex matched = 0;
  Direction direction = Direction::kSame;
  Verdict verdict = Verdict::kIllConditioned;
  GatedDifference difference;
  // Only of relative alignments.
  std::optional<RelativeEvidence> relative;
  // The alignment, oldest first: (node of the recent path, node of the
  // history). Empty if SearchOptions::tell_paths is not set.
  std::vector<std::pair<NodeIndex, NodeIndex>> path;
};

enum class EmptyReason {
  // There are candidates.
  kNotEmpty,
  // Up to the query, from the start or the last jump, the path is shorter than
  // the sequence.
  kPathTooShort,
  // No nodes before the sequence.
  kNoHistory,
  // Every node before the sequence is within the separation of the query.
  kAllSuppressed,
  // No path of the history is as long as the sequence, or Gamma is
  // ill-conditioned along all of them.
  kNoAlignment,
  // No node left to be considered could come to any odds: see nodes_pruned.
  kNoProbablePlace,
  // More than SearchOptions::max_comparisons.
  kTooMuchWork,
};

struct CandidateSet {
  // The node that was asked about; nothing if the graph is empty.
  std::optional<NodeIndex> query;
  std::vector<Candidate> candidates;
  EmptyReason empty_reason = EmptyReason::kNotEmpty;
  // Nodes of the history that were compared with the query, and those that were
  // not: all of them together have odds below 1e-6 against a new place.
  NodeIndex nodes_considered = 0;
  NodeIndex nodes_pruned = 0;
  // What SearchOptions::max_comparisons bounds.
  std::int64_t comparisons = 0;
  // Only of relative alignments: posterior of no place of the history.
  std::optional<double> new_place_probability;
  // What the claimed standard deviations were multiplied by.
  double inflation = 1.0;
};

struct AppendResult {
  std::vector<Jump> jumps;
  // Nodes at which a check fell due: the first at or after each multiple of the
  // check interval, from two sequence lengths on.
  std::vector<NodeIndex> checks_due;
};

class Engine {
 public:
  // REQUIRES: FindProblems(settings) is empty.
  explicit Engine(const EngineSettings& settings);

  const EngineSettings& settings() const { return settings_; }
  const PoseGraph& graph() const { return graph_; }
  // Memory that the graph and what is kept for searching it take, without what
  // an allocator adds.
  std::size_t bytes() const {
    return graph_.bytes() + motion_history_.bytes() + block_bounds_.bytes();
  }
  // Last pose appended; 0 before the first.
  std::uint64_t last_sequence() const { return last_sequence_; }
  double travelled_meters() const { return resampler_.travelled_meters(); }
  // Grows with every change, by what the caller says; 0 at first.
  std::uint64_t revision() const { return revision_; }

  // REQUIRES: samples without defect, of sequences that follow last_sequence();
  // revision greater than revision().
  AppendResult Append(const std::vector<PoseSample>& samples,
                      std::uint64_t revision);

  // Replaces the settings of searches and checks that do not move nodes.
  // REQUIRES: valid, same state space, node spacing and maximal step; whether
  // the model is kFilter does not change; revision greater than revision().
  void ChangeSettings(const EngineSettings& settings, std::uint64_t revision);

  // Adds or removes an edge between the last nodes at or before two poses. Two
  // poses at one node make no edge; that is not an error.
  // REQUIRES: sequences in [1, last_sequence()], revision greater than
  // revision().
  void AddLoopClosure(std::uint64_t query_sequence,
                      std::uint64_t matched_sequence, std::uint64_t revision);
  // `occurrence`: which of those that name the same two poses, from 0, in the
  // order in which they were added.
  void RemoveLoopClosure(std::uint64_t query_sequence,
                         std::uint64_t matched_sequence, std::uint64_t revision,
                         std::size_t occurrence = 0);

  // Takes a pair of poses for verified not to be one place: ends within
  // kPlaceRadiusMeters of the second, or the candidate separation if that is
  // more, are no longer candidates at nodes as near to the first. The same pair
  // may be rejected more than once.
  // REQUIRES: as for loop closures.
  void AddRejection(std::uint64_t query_sequence,
                    std::uint64_t matched_sequence, std::uint64_t revision);
  void RemoveRejection(std::uint64_t query_sequence,
                       std::uint64_t matched_sequence, std::uint64_t revision);

  // As of the last change. Replaying the same loop closures in another order
  // may give another inflation.
  Consistency consistency() const;

  // Candidates at a node, with the nodes before its sequence as history. The
  // answer depends on the graph up to the query only, but for loop closures,
  // rejections, and the inflation they ask for.
  // CANCELLED if told to stop.
  // REQUIRES: query in the graph; FindProblems(options, settings()) is empty.
  absl::StatusOr<CandidateSet> FindCandidates(
      NodeIndex query, const SearchOptions& options,
      const ShouldStop& should_stop) const;

  // The same at the newest node; the answer says so if there is none.
  absl::StatusOr<CandidateSet> FindCandidates(
      const SearchOptions& options, const ShouldStop& should_stop) const;

 private:
  std::optional<std::pair<NodeIndex, NodeIndex>> LoopEdge(
      std::uint64_t query_sequence, std::uint64_t matched_sequence) const;
  void ScheduleNextCheck();
  MotionHistory MakeMotionHistory() const;
  // Takes on the nodes that were added.
  void ExtendIndexes();
  // Learns all confirmed loops anew.
  void RebuildMonitor();
  // The last one whose nodes both lie at or before the query.
  std::optional<ConfirmedLoop> LastConfirmed(NodeIndex query) const;
  SimilarityModel MakeSimilarityModel(const SearchOptions& options) const;
  // What is not to be offered at the query: what is near it, and what was
  // rejected there.
  std::vector<NodeRange> NotSought(NodeIndex query,
                                   double separation_meters) const;
  // Fill the candidates; CANCELLED if told to stop.
  absl::Status FindComposite(NodeIndex query, std::int64_t steps,
                             NodeIndex history_size,
                             const SearchOptions& options,
                             const ShouldStop& should_stop,
                             CandidateSet* set) const;
  // `undecided`, if given: ends are left out that have at most kPrunedShare
  // of all odds together, and it says whether any verdict might be another with
  // them.
  absl::Status FindRelative(NodeIndex query, std::int64_t steps,
                            NodeIndex history_size,
                            const SearchOptions& options,
                            const ShouldStop& should_stop, CandidateSet* set,
                            bool* undecided) const;

  EngineSettings settings_;
  PoseGraph graph_;
  DistanceResampler resampler_;
  // For searches with the vehicle's own options.
  MotionHistory motion_history_;
  BlockBounds block_bounds_;
  std::uint64_t last_sequence_ = 0;
  std::uint64_t revision_ = 0;
  struct Confirmed {
    std::uint64_t query_sequence;
    std::uint64_t matched_sequence;
    ConfirmedLoop loop;
  };
  // Verified pairs, in the order they came.
  std::vector<Confirmed> confirmed_;
  std::vector<std::pair<NodeIndex, NodeIndex>> rejected_;
  ConsistencyMonitor monitor_;
  // Number of the next check: it is due at this many check intervals.
  std::int64_t next_check_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_ENGINE_H_
