// How much a path back from each node of the history can gain at most, as far
// as headings tell: an upper bound, from one byte of each node.
//
// The squared innovations of a path sum up to e^T C^-1 e, with e its mismatches
// up to where it ends and C their covariance. Those of some of its headings
// alone, (e_1, ..., e_n) with the covariance that C has for these, sum up to no
// more. By itself the heading's drift is a random walk, which each node strays
// from, so that this sum is that of a filter of one number:
//
//   drift_k = drift_(k-1) + noise,  e_k = drift_k + straying.
//
// A heading is looked at every few steps, and at more of them where that
// matters. Those that the bins, and up to kMostSlips slips either way, leave
// open are taken for the likeliest. So the bound holds for paths without more
// slips than these at a time; each slip costs kSlipCost. The bound by more
// headings is one that a few paths in a million exceed a little: kNotBorneOut.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_MATCH_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_MATCH_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/heading_bins.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/heading_kernel.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"

namespace revisit::core {

inline constexpr NodeIndex kMostSlips = 2;

class HeadingMatch {
 public:
  // Nothing where the history's headings are not known, or the recent path,
  // that of the query, is too short to tell. The bins must outlive this.
  template <int D>
  static std::optional<HeadingMatch> Make(const Query& query,
                                          const History& history,
                                          const RecentPath<D>& recent);

  // For each node of a block, the most that the log-likelihood ratio of a path
  // from it can come to. Remembers it; not thread-safe.
  void Bound(std::size_t block, Direction direction, BlockRatios* most) const;
  // The same, as closely as headings tell where it is more than `enough`; what
  // is less than that may be told as so much.
  void Bound(std::size_t block, Direction direction, float enough,
             BlockRatios* most) const;

 private:
  HeadingMatch(const HeadingBins& bins, NodeIndex history_size)
      : bins_(bins), size_(history_size) {}

  // The ratios of a block, from few headings; and, of those that are more than
  // `enough`, from more of them.
  struct Bounds {
    BlockRatios most = {};
    BlockRatios lower = {};
    float enough = std::numeric_limits<float>::infinity();
  };

  Bounds& Known(std::size_t block, Direction direction) const;
  template <typename Use>
  void WithBins(NodeIndex first, Direction direction, const Use& use) const;

  const HeadingBins& bins_;
  NodeIndex size_;
  // Farthest step.
  NodeIndex reach_ = 0;
  // For paths back in time, and forward: few steps, and more of them.
  float least_ = 0.0F;
  std::array<std::vector<HeadingStep>, 2> steps_;
  HeadingVariances variances_around_;
  float least_around_ = 0.0F;
  std::array<std::vector<HeadingStep>, 2> steps_around_;
  // The bounds that are known, by direction and block.
  mutable std::array<std::vector<std::unique_ptr<Bounds>>, 2> known_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_MATCH_H_
