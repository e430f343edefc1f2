// Asks a drive where its vehicle has probably been before.
//
// A search begins with what marks along the drive have shown (belief/mark.h).
// Their evidence is found once and kept here, so whoever searches a drive again
// and again keeps the Search; another one answers the same, later.
//
// Thread-compatible.
#ifndef REVISIT_CORE_SEARCH_SEARCH_H_
#define REVISIT_CORE_SEARCH_SEARCH_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/drive/node_range.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/belief/mark.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/search_task.h"
#include "core/settings.h"

namespace revisit::core {

class Search {
 public:
  // A mark that a search begins with and whose evidence is not known yet.
  struct MissingMark {
    std::int64_t mark;
    // As CandidateSet::comparisons: of the mark, and of the search that needs
    // it.
    std::int64_t comparisons;
    std::int64_t comparisons_of_search;
  };

  // The drive must outlive the search. It may grow and change between calls.
  explicit Search(const Drive* drive) : drive_(*drive) {}

  // Candidates at a node, with the nodes before its sequence as the history.
  // The answer depends only on the graph up to the query, on loop closures and
  // rejections, and on the inflation that these result in. Returns CANCELLED if
  // told to stop.
  // REQUIRES: query in the graph; FindProblems(options, settings()) is empty.
  absl::StatusOr<CandidateSet> At(NodeIndex query, const SearchOptions& options,
                                  const ShouldStop& should_stop);
  // The same at the newest node; kPathTooShort if the graph is empty.
  absl::StatusOr<CandidateSet> AtEnd(const SearchOptions& options,
                                     const ShouldStop& should_stop);

  // CandidateSet::comparisons of the search, before it is made, without those
  // of marks; 0 if there is nothing to compare, or too much. REQUIRES: as for
  // At().
  std::int64_t ComparisonsAt(NodeIndex query,
                             const SearchOptions& options) const;
  // The first mark that is missing for this search, if any. Whoever has all of
  // them learned first can do other work between them; At() learns those that
  // are still missing itself, without counting them, and answers the same.
  // REQUIRES: as for At().
  std::optional<MissingMark> FindMissingMark(NodeIndex query,
                                             const SearchOptions& options);
  // Returns CANCELLED if told to stop. REQUIRES: the mark is missing.
  absl::Status LearnMark(const MissingMark& missing,
                         const ShouldStop& should_stop);

  // How many marks have evidence here.
  std::size_t mark_count() const { return marks_.size(); }

 private:
  // The nodes that are compared at a query.
  struct Extent {
    // Why there is nothing to compare.
    std::optional<EmptyReason> empty;
    // Nodes of the path that is aligned with the history.
    std::int64_t aligned = 0;
    NodeIndex history_size = 0;
    std::int64_t comparisons = 0;
  };
  // The marks that show something at a query.
  struct MarksBefore {
    ScaleMarks of_scale;
    std::int64_t first_of_drift;
    std::int64_t last;
  };

  Extent ExtentOf(NodeIndex query, const SearchOptions& options) const;
  // The same of a search, which may also be refused.
  Extent ExtentOfSearch(NodeIndex query, const SearchOptions& options) const;
  // REQUIRES: the query's segment has as many nodes as the sequence up to the
  // query.
  std::int64_t AlignedNodes(NodeIndex query, std::int64_t sequence_nodes,
                            const SearchOptions& options) const;
  Query QueryAt(NodeIndex node, const Extent& extent) const;
  // What the drive's own past has for such a query.
  History PastOf(const Extent& extent, std::vector<NodeRange> not_sought) const;
  // Searches the marks that are not known. Returns CANCELLED if told to stop.
  absl::StatusOr<SearchPrior> PriorAt(NodeIndex query,
                                      const SearchOptions& options,
                                      const ShouldStop& should_stop);
  MarksBefore FindMarksBefore(NodeIndex query) const;
  // What the drive has shown before the query. Searches the marks that are not
  // known. Returns CANCELLED if told to stop.
  absl::StatusOr<DriveBelief> BeliefAt(NodeIndex query,
                                       const ShouldStop& should_stop);
  // Whether a mark shows the drift at the query.
  bool ShowsDrift(const MarkEvidence& mark, NodeIndex query) const;
  // The evidence of a mark at this node. `parts`: see SearchTask.
  absl::StatusOr<MarkEvidence> EvidenceAt(
      NodeIndex node, const ShouldStop& should_stop,
      std::vector<AlignmentParts>* parts = nullptr) const;
  MarkLine Marks() const;
  // Whether a search with these options aligns the path that a mark there does.
  bool AlignsAsMarks(const SearchOptions& options) const;
  // Searches the mark at the query, if there is one that is not known. The
  // parts are those of a search there.
  void RememberIfMark(NodeIndex query, const ShouldStop& should_stop,
                      std::vector<AlignmentParts>* parts);

  const Drive& drive_;
  MarkMemory marks_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_SEARCH_H_
