#include "core/base/suggestion.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"

namespace revisit {

std::size_t EditDistance(const std::string& a, const std::string& b) {
  // distance[i][j] is that of the first i letters of `a` and j of `b`.
  std::vector<std::vector<std::size_t>> distance(
      a.size() + 1, std::vector<std::size_t>(b.size() + 1));
  for (std::size_t i = 0; i <= a.size(); ++i) {
    for (std::size_t j = 0; j <= b.size(); ++j) {
      if (i == 0 || j == 0) {
        distance[i][j] = i + j;
        continue;
      }
      const std::size_t replaced = a[i - 1] == b[j - 1] ? 0 : 1;
      distance[i][j] = std::min({distance[i - 1][j] + 1, distance[i][j - 1] + 1,
                                 distance[i - 1][j - 1] + replaced});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1]) {
        distance[i][j] = std::min(distance[i][j], distance[i - 2][j - 2] + 1);
      }
    }
  }
  return distance[a.size()][b.size()];
}

std::string Suggestion(const std::string& word,
                       const std::vector<std::string>& known) {
  constexpr std::size_t kLeastBeginning = 3;
  std::string best;
  std::size_t least = word.size();
  for (const std::string& candidate : known) {
    const bool begins =
        word.size() >= kLeastBeginning && candidate.rfind(word, 0) == 0;
    const std::size_t distance = begins ? 1 : EditDistance(word, candidate);
    if (distance < least && 3 * distance <= candidate.size() + 1) {
      least = distance;
      best = candidate;
    }
  }
  return best;
}

std::string MistypedWord(const std::string& word,
                         const std::vector<std::string>& known) {
  const std::string meant = Suggestion(word, known);
  return absl::StrCat(
      "got \"", word, "\"; ",
      meant.empty() ? "" : absl::StrCat("did you mean ", meant, "? "),
      "allowed is ",
      known.empty() ? "nothing here" : absl::StrJoin(known, ", "));
}

}  // namespace revisit
