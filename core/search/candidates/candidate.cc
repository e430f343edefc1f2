#include "core/search/candidates/candidate.h"

#include <algorithm>
#include <cstddef>

namespace revisit::core {

void KeepBest(int count, std::vector<Candidate>* candidates) {
  std::stable_sort(
      candidates->begin(), candidates->end(),
      [](const Candidate& a, const Candidate& b) { return a.score > b.score; });
  if (candidates->size() > static_cast<std::size_t>(count)) {
    candidates->resize(static_cast<std::size_t>(count));
  }
}

}  // namespace revisit::core
