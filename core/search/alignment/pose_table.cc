#include "core/search/alignment/pose_table.h"

#include <algorithm>

namespace revisit::core {

PoseTable::PoseTable(const PoseGraph& graph, NodeIndex size)
    : graph_(graph),
      size_(size),
      // The entries are left uninitialized, because most of them may never be
      // looked at.
      poses_(new double[4 * static_cast<std::size_t>(size)]),
      filled_(BlocksOf(size)) {
  // Kernels read node 0 where they have no walker.
  if (size > 0) Need(0, 0);
}

void PoseTable::Need(NodeIndex first, NodeIndex last) {
  constexpr auto kSize = static_cast<NodeIndex>(NodeBlock::kSize);
  first = std::max<NodeIndex>(first, 0);
  last = std::min(last, size_ - 1);
  for (NodeIndex k = first / kSize; k * kSize <= last; ++k) {
    if (!filled_[static_cast<std::size_t>(k)]) Fill(k);
  }
}

void PoseTable::Fill(NodeIndex k) {
  filled_[static_cast<std::size_t>(k)] = 1;
  const NodeBlock& block = graph_.block(static_cast<std::size_t>(k));
  const auto first = static_cast<std::size_t>(k) * NodeBlock::kSize;
  const std::size_t count =
      std::min(NodeBlock::kSize, static_cast<std::size_t>(size_) - first);
  double* entry = poses_.get() + 4 * first;
  // The next block is most probably needed next. (z is elsewhere.)
  constexpr std::size_t kPoseRows = NodeBlock::kHeading + 1;
  const auto next = static_cast<std::size_t>(k) + 1;
  const NodeBlock& fetched =
      next < filled_.size() && !filled_[next] ? graph_.block(next) : block;
  for (std::size_t i = 0; i < count; ++i, entry += 4) {
    if (i % NodeBlock::kGroupSize == 0) fetched.Prefetch(i, kPoseRows);
    const Pose pose = block.pose(i);
    entry[0] = pose.x;
    entry[1] = pose.y;
    entry[2] = pose.z;
    entry[3] = pose.heading;
  }
}

}  // namespace revisit::core
