// How much a path can gain at most, as far as headings tell: the shape filter
// of headings alone (heading_match.h), for a block of ends at once, with the
// widest vectors of the machine.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_KERNEL_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_KERNEL_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"

namespace revisit::core {

// A step of the filter. Angles are in bins of HeadingBins.
struct HeadingStep {
  // How far along the array of bins the node of a path is from its end.
  std::ptrdiff_t offset = 0;
  // Heading of the recent path's node less that of its end: rounded, and what
  // that leaves out.
  std::uint8_t turn = 0;
  float rest = 0.0F;
  // The gain K of the filter, and the inverse of its innovation's variance.
  float gain = 0.0F;
  float information = 0.0F;
  // The most that the log-likelihood ratio of a path can come to which ends
  // before the next step: had it no innovation.
  float most_ratio = 0.0F;
};

// Variances of the filter: of the drift at the end, of what it gains from one
// step to the next, and of what a node strays from it.
struct HeadingVariances {
  float end = 0.0F;
  float noise = 0.0F;
  float straying = 0.0F;
};

using BlockRatios = std::array<float, NodeBlock::kSize>;

// For each of NodeBlock::kSize ends, the bins of whose nodes begin at `bins`,
// the most that the log-likelihood ratio of a path can come to. `least`: that
// of a path which ends before the first step. A step's node may also be any
// within `slips` nodes. REQUIRES: there are bins at all of these offsets.
void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most);

// Lowers those ratios that are more than `enough` to what these steps show, but
// not below `enough`. A step counts for an end only where no slip changes its
// heading much, so the gains of the steps do not count.
void LowerRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps,
                 const HeadingVariances& variances, float least,
                 std::ptrdiff_t slips, float enough, BlockRatios* most);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_KERNEL_H_
