// The inputs that both directions of an alignment's search have in common.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_INPUTS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_INPUTS_H_

#include <array>

#include "core/search/alignment/heading_match.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/search_bounds.h"
#include "core/search/alignment/walked_ends.h"

namespace revisit::core {

// All must outlive the searches.
template <int D>
struct SearchInputs {
  const Query& query;
  const History& history;
  const RelativeModel& model;
  // The poses of the query's path, and the path as the history sees it.
  const RecentPath<D>& recent;
  const PathAxes<D>& axes;
  const SearchBounds<D>& bounds;
  // Null where ends are not sampled.
  const HeadingMatch* headings;
  // The poses of the history, filled in on the way.
  PoseTable* table;
  // The ends that were walked from, by IndexOf(direction), or null.
  std::array<WalkedEnds, 2>* walked;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_INPUTS_H_
