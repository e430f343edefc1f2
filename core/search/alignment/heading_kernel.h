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
  // Heading of the recent path's node less that of its end, rounded.
  std::uint8_t turn = 0;
  // The gain K of the filter, and the inverse of its innovation's variance.
  float gain = 0.0F;
  float information = 0.0F;
  // The most that the log-likelihood ratio of a path can come to which ends
  // before the next step: had it no innovation.
  float most_ratio = 0.0F;
};

using BlockRatios = std::array<float, NodeBlock::kSize>;

// For each of NodeBlock::kSize ends, the bins of whose nodes begin at `bins`,
// the most that the log-likelihood ratio of a path can come to. `least`: that
// of a path which ends before the first step. A step's node may also be any
// within `slips` nodes. REQUIRES: there are bins at all of these offsets.
void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_HEADING_KERNEL_H_
