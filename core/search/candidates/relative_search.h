// Candidates by relative alignment (relative.h), weighed against each other and
// against a new place.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_SEARCH_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_SEARCH_H_

#include <cstddef>
#include <functional>
#include <vector>

#include "absl/status/status.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/search_task.h"

namespace revisit::core {

// Share of all odds, a new place's 1 among them, that a search may leave out,
// all ends together.
inline constexpr double kPrunedShare = 1e-6;

// Ends with log-odds below this (odds of 1 in 100) are sampled (relative.h),
// unless the search is exhaustive: where drift fills a town, probabilities are
// off by some thousandths (tests/core/search/alignment/sampled_ends_test.cc).
inline constexpr double kMostLogOddsSampled = -4.6;

// The model of a task. Ends of all histories are pruned that have at most
// `pruned_share` of all odds together; none if it is 0.
RelativeModel ModelOf(const SearchTask& task, double pruned_share);
// The same for histories that are other recordings, where the drift is another.
RelativeModel ModelAcross(const RelativeModel& model);

// The histories of other drives that are passed over as one.
struct PassedOver {
  bool Has(std::size_t history) const {
    return !are_far.empty() && are_far[history] != 0;
  }

  // By history, whether it is far away (far_histories.h); empty if none is.
  std::vector<char> are_far;
  // The path by which this was told.
  AlignmentParts path;
};
PassedOver FindFar(const SearchTask& task, const RelativeModel& across);

// Aligns the task's query with one history after the other; alignments do not
// depend on each other. Other recordings take the model `across`. Those that
// are passed over have no ends. False if told to stop.
bool VisitAlignments(
    const SearchTask& task, const RelativeModel& model,
    const RelativeModel& across, const PassedOver& passed_over,
    const std::function<void(const History&, RelativeAlignment)>& visit);

// Fills in the candidates and the probability of a new place; leaves that out
// where no covariance is well-conditioned. Unless the search is exhaustive,
// ends are sampled, and pruned that have at most 1e-6 of all odds together, as
// long as no verdict depends on what was pruned. kTooMuchWork, and nothing
// else, where histories of other drives that are not passed over are too many.
// Returns CANCELLED if told to stop.
absl::Status SearchRelative(const SearchTask& task, CandidateSet* set);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_RELATIVE_SEARCH_H_
