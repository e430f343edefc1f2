#include "core/search/candidates/ranking.h"

#include <algorithm>
#include <cstddef>

#include "core/drive/node_range.h"
#include "core/search/alignment/log_similarity.h"

namespace revisit::core {
namespace {

// The best of the ends that are not struck out. Keeps the best of each group,
// so that it is found again quickly after some are.
class BestEnds {
 public:
  explicit BestEnds(const ScoredEnds& ends)
      : ends_(ends),
        struck_out_(ends.size()),
        best_((ends.size() + kGroup - 1) / kGroup) {
    for (std::size_t g = 0; g < best_.size(); ++g) FindBest(g);
  }

  // The best end, of equal scores the first; its score is kImpossible if there
  // is none.
  ScoredEnd Best() const {
    ScoredEnd best = kNone;
    for (const ScoredEnd& of_group : best_) {
      if (of_group.score > best.score) best = of_group;
    }
    return best;
  }

  void StrikeOut(std::size_t first, std::size_t last) {
    std::fill(struck_out_.begin() + static_cast<std::ptrdiff_t>(first),
              struck_out_.begin() + static_cast<std::ptrdiff_t>(last), 1);
    for (std::size_t g = first / kGroup; g * kGroup < last; ++g) FindBest(g);
  }

 private:
  static constexpr std::size_t kGroup = 128;
  static constexpr ScoredEnd kNone{-1, kImpossible};

  void FindBest(std::size_t group) {
    const std::size_t last = std::min(ends_.size(), (group + 1) * kGroup);
    ScoredEnd best = kNone;
    for (std::size_t i = group * kGroup; i < last; ++i) {
      if (ends_[i].score > best.score && !struck_out_[i]) best = ends_[i];
    }
    best_[group] = best;
  }

  const ScoredEnds& ends_;
  std::vector<char> struck_out_;
  std::vector<ScoredEnd> best_;
};

}  // namespace

std::vector<RankedEnd> RankEnds(const PoseGraph& graph, const ScoredEnds& ends,
                                double separation_meters, int max_candidates) {
  std::vector<RankedEnd> ranked;
  BestEnds left(ends);
  while (static_cast<int>(ranked.size()) < max_candidates) {
    const ScoredEnd best = left.Best();
    if (best.score == kImpossible) break;
    ranked.push_back({best.node, best.score});
    const EndsAround near = FindEndsAround(ends, best.node, [&](NodeIndex i) {
      return IsNearer(graph, best.node, separation_meters, i);
    });
    left.StrikeOut(near.first, near.last);
  }
  return ranked;
}

}  // namespace revisit::core
