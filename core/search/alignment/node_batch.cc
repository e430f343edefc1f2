#include "core/search/alignment/node_batch.h"

#include <algorithm>
#include <numeric>

#include "core/drive/node_range.h"

namespace revisit::core {

BlockNodes SoughtIn(const History& history, std::size_t k) {
  constexpr auto kSize = static_cast<NodeIndex>(NodeBlock::kSize);
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  const NodeIndex count = std::min(kSize, history.end - first);
  BlockNodes sought;
  sought.set();
  for (NodeIndex i = first; i < std::min(history.first, first + kSize); ++i) {
    sought.reset(static_cast<std::size_t>(i - first));
  }
  for (const NodeRange& nodes : history.not_sought) {
    const NodeIndex last = std::min(nodes.last - first, count);
    for (NodeIndex i = std::max<NodeIndex>(nodes.first - first, 0); i < last;
         ++i) {
      sought.reset(static_cast<std::size_t>(i));
    }
  }
  return sought;
}

template <int D>
void NodeBatch<D>::TakeBlock(std::size_t k, std::size_t next) {
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  size_ = std::min(NodeBlock::kSize,
                   static_cast<std::size_t>(history_.end - first));
  std::iota(nodes_.begin(), nodes_.end(), first);
  anchors_.Find(k, size_, next);
}

template <int D>
void NodeBatch<D>::Gather(const NodeIndex* nodes, std::size_t count) {
  size_ = count;
  for (std::size_t i = 0; i < count; ++i) {
    nodes_[i] = nodes[i];
    indices_[i] = static_cast<double>(nodes[i]);
    gathered_.Copy(history_.graph.block(BlockOf(nodes[i])),
                   PlaceInBlock(nodes[i]), i);
  }
  anchors_.FindAmong(
      gathered_, indices_, count,
      static_cast<NodeIndex>(BlockOf(nodes[0]) * NodeBlock::kSize));
}

template class NodeBatch<3>;
template class NodeBatch<4>;

}  // namespace revisit::core
