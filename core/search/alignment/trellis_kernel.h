// One step of the trellis for a block of nodes, each with an edge to the node
// before and the node after it and no others. Computes many nodes at a time, as
// similarity_kernel.h does.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_TRELLIS_KERNEL_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_TRELLIS_KERNEL_H_

#include <cstddef>
#include <cstdint>

#include "core/drive/pose_graph.h"

namespace revisit::core {

// Bytes of one step and block: a bit per node.
inline constexpr std::size_t kStepBytes = NodeBlock::kSize / 8;

// For each node k of the block:
//
//   next[k] = max(leaving[k - 1], leaving[k + 1]) + emission[k] - cost
//
// and bit k of `from_after`, eight per byte, is whether leaving[k + 1] was the
// greater of the two. leaving[-1] and leaving[NodeBlock::kSize] must be
// readable.
void StepBlock(const double* leaving, const double* emission, double cost,
               double* next, std::uint8_t* from_after);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_TRELLIS_KERNEL_H_
