// Nodes of the history that are looked at together, as many as a block holds at
// most: a block of the graph, or nodes from anywhere.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_NODE_BATCH_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_NODE_BATCH_H_

#include <array>
#include <cstddef>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/anchors.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/search_inputs.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// The nodes of block k that may be ends. Those beyond the history's end count
// as if they might.
BlockNodes SoughtIn(const History& history, std::size_t k);

// Takes new nodes again and again without allocating memory.
template <int D>
class NodeBatch {
 public:
  NodeBatch(const SearchInputs<D>& inputs, Direction direction)
      : history_(inputs.history),
        anchors_(inputs.query, inputs.history, inputs.model, inputs.recent,
                 inputs.axes, direction) {}

  // Takes the nodes of block k. `next`: the block that will be asked for after
  // it. REQUIRES: where the noise model has no closed form, k falls from call
  // to call.
  void TakeBlock(std::size_t k, std::size_t next);
  // Takes copies of these nodes. REQUIRES: NoiseModel::neighbours_err_alike;
  // the same drifts reach into the blocks of all; count in [1,
  // NodeBlock::kSize].
  void Gather(const NodeIndex* nodes, std::size_t count);

  std::size_t size() const { return size_; }
  NodeIndex node(std::size_t i) const { return nodes_[i]; }

  // How well the nodes agree with the query.
  Anchors<D>& anchors() { return anchors_; }
  const Anchors<D>& anchors() const { return anchors_; }

 private:
  const History& history_;
  std::size_t size_ = 0;
  std::array<NodeIndex, NodeBlock::kSize> nodes_;
  Anchors<D> anchors_;
  // Copies of nodes, where these are no block of the graph.
  NodeBlock gathered_;
  alignas(64) BlockColumn indices_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_NODE_BATCH_H_
