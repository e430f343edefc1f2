// The best paths back from ends that were walked from, for other searches that
// walk the same recent path back through the same history in the same
// direction, over no loop closures.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_WALKED_ENDS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_WALKED_ENDS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/search_progress.h"

namespace revisit::core {

// Takes some 60 bytes an end, and half a kilobyte for each block that has one.
class WalkedEnds {
 public:
  // A path as BestPaths has it.
  struct Path {
    double log_likelihood_ratio = 0.0;
    double squared_innovations = 0.0;
    std::int64_t steps = 0;
    std::array<double, 4> shift = {};
  };

  // Null if the end is not known. The path stays where it is until another one
  // is kept.
  const Path* Find(NodeIndex end) const {
    const std::size_t k = BlockOf(end);
    if (k >= numbers_.size() || numbers_[k] == nullptr) return nullptr;
    const std::uint32_t number = (*numbers_[k])[PlaceInBlock(end)];
    return number == 0 ? nullptr : &paths_[number - 1];
  }

  // REQUIRES: the end is not known.
  void Keep(NodeIndex end, const Path& path) {
    const std::size_t k = BlockOf(end);
    if (k >= numbers_.size()) numbers_.resize(k + 1);
    if (numbers_[k] == nullptr) numbers_[k] = std::make_unique<Numbers>();
    paths_.push_back(path);
    (*numbers_[k])[PlaceInBlock(end)] =
        static_cast<std::uint32_t>(paths_.size());
  }

 private:
  // The number of each node's path, from 1 on; 0 where there is none.
  using Numbers = std::array<std::uint32_t, NodeBlock::kSize>;

  // By block.
  std::vector<std::unique_ptr<Numbers>> numbers_;
  std::vector<Path> paths_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_WALKED_ENDS_H_
