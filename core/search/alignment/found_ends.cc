#include "core/search/alignment/found_ends.h"

#include <algorithm>

namespace revisit::core {

MatchedEnds FoundEnds::HandOver(double least) {
  const auto older = [](const Found& a, const Found& b) {
    return a.end.node < b.end.node;
  };
  // Where all blocks are searched, from the last to the first, this sorts.
  std::reverse(found_.begin(), found_.end());
  if (!std::is_sorted(found_.begin(), found_.end(), older)) {
    std::sort(found_.begin(), found_.end(), older);
  }
  MatchedEnds matched;
  matched.ends.reserve(found_.size());
  matched.matches.reserve(found_.size());
  for (const Found& found : found_) {
    if (!(found.end.score >= least)) continue;
    matched.ends.push_back(found.end);
    matched.matches.push_back(found.match);
    const auto odds =
        odds_by_scale_.begin() + static_cast<std::ptrdiff_t>(found.first_scale);
    matched.odds_by_scale.insert(matched.odds_by_scale.end(), odds,
                                 odds + static_cast<std::ptrdiff_t>(scales_));
  }
  return matched;
}

}  // namespace revisit::core
