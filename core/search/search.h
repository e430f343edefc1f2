// Asks a drive where its vehicle has probably been before.
//
// A search begins with what marks along the drive have shown (belief/mark.h).
// Their evidence is found once and kept here, so whoever searches a drive again
// and again keeps the Search, or what SaveMarks() gives; another one answers
// the same, later.
//
// Thread-compatible.
#ifndef REVISIT_CORE_SEARCH_SEARCH_H_
#define REVISIT_CORE_SEARCH_SEARCH_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/drive/node_index.h"
#include "core/search/candidates/candidate.h"
#include "core/search/should_stop.h"
#include "core/settings.h"

namespace revisit::core {

class Drive;
struct SearchScope;

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
  explicit Search(const Drive* drive);
  ~Search();

  // Candidates at a node, with the nodes before its sequence as the history.
  // The answer depends only on the graph up to the query, on loop closures and
  // rejections, and on the inflation that these result in. Returns CANCELLED if
  // told to stop.
  // REQUIRES: query in the graph; FindProblems(options, settings()) is empty.
  absl::StatusOr<CandidateSet> At(NodeIndex query, const SearchOptions& options,
                                  const ShouldStop& should_stop);
  // The same in a scope: in the histories of the drives that it searches, and
  // the drive's own unless that is excluded, against one new place. The answer
  // depends on what the scope holds too. What the drive has shown of its scale
  // and its drift (belief/mark.h) does not. REQUIRES: as for At().
  absl::StatusOr<CandidateSet> At(NodeIndex query, const SearchOptions& options,
                                  const SearchScope& scope,
                                  const ShouldStop& should_stop);
  // The same as without a scope at the newest node; kPathTooShort if the graph
  // is empty.
  absl::StatusOr<CandidateSet> AtEnd(const SearchOptions& options,
                                     const ShouldStop& should_stop);

  // CandidateSet::comparisons of the search without a scope, before it is made,
  // without those of marks; 0 if there is nothing to compare, or too much.
  // REQUIRES: as for At().
  std::int64_t ComparisonsAt(NodeIndex query,
                             const SearchOptions& options) const;
  // The comparisons that the last call of At() was about to make, also if it
  // was told to stop; 0 if there was nothing to compare, or too much.
  std::int64_t last_comparisons() const;
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
  std::size_t mark_count() const;
  // Grows whenever a mark gets its evidence; 0 before.
  std::uint64_t marks_version() const;
  // The evidence of marks as bytes (belief/mark_bytes.h), for another Search of
  // the same drive, which with them answers what it does without, and sooner.
  std::string SaveMarks();
  // Takes what was saved in the place of what is known; false, and nothing
  // changes, if the bytes are damaged, or of other poses, settings or another
  // version.
  bool LoadMarks(absl::string_view bytes);

 private:
  class Impl;

  const std::unique_ptr<Impl> impl_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_SEARCH_H_
