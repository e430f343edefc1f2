// The search of a mark: what one node of a drive shows of the claimed
// covariances and of the drift (core/search/belief).
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_MARK_SEARCH_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_MARK_SEARCH_H_

#include "absl/status/statusor.h"
#include "core/search/belief/mark.h"
#include "core/search/candidates/search_task.h"
#include "core/settings.h"

namespace revisit::core {

// Searches with nothing believed yet but the prior of the scale, and without
// closures: the answer depends on the poses up to the query alone. Returns
// CANCELLED if told to stop. REQUIRES: the task's options are MarkOptions(),
// and its only history is the drive's own past.
absl::StatusOr<MarkEvidence> SearchMark(const SearchTask& task);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_MARK_SEARCH_H_
