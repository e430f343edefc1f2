#ifndef REVISIT_CORE_DRIVE_HEADING_BINS_H_
#define REVISIT_CORE_DRIVE_HEADING_BINS_H_

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"

namespace revisit::core {

// Bins of a full turn: differences of headings wrap as bytes do.
inline constexpr double kHeadingBins = 256.0;

// An angle in bins, not rounded.
inline double InHeadingBins(double angle) {
  return angle * (kHeadingBins / (2.0 * kPi));
}

// The heading of each node, rounded to bins: a byte for each.
//
// Thread-compatible: const calls may run at the same time.
class HeadingBins {
 public:
  // Adds the nodes that the graph has grown by.
  void Extend(const PoseGraph& graph) {
    const auto size = static_cast<std::size_t>(graph.size());
    // Doubling would leave too much memory unused.
    if (size > bins_.capacity()) bins_.reserve(size + size / 8);
    for (auto i = static_cast<NodeIndex>(bins_.size()); i < graph.size(); ++i) {
      bins_.push_back(static_cast<std::uint8_t>(
          std::lround(InHeadingBins(graph.pose(i).heading))));
    }
  }

  NodeIndex size() const { return static_cast<NodeIndex>(bins_.size()); }
  const std::vector<std::uint8_t>& bins() const { return bins_; }
  std::size_t bytes() const { return bins_.capacity(); }

 private:
  std::vector<std::uint8_t> bins_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_HEADING_BINS_H_
