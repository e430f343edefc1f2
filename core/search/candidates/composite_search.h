// Candidates by the paper's alignment (viterbi.h), judged by the gate alone.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_COMPOSITE_SEARCH_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_COMPOSITE_SEARCH_H_

#include "absl/status/status.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/search_task.h"

namespace revisit::core {

// Fills in the candidates. Returns CANCELLED if told to stop. REQUIRES: the
// only history is the asking drive's own past, with its graph; the paper's
// alignment takes the two for one.
absl::Status SearchComposite(const SearchTask& task, CandidateSet* set);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_COMPOSITE_SEARCH_H_
