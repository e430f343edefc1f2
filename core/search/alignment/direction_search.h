// The search of a relative alignment in one direction: block by block, or first
// by samples, and then of the ends that were kept, the likeliest first.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_DIRECTION_SEARCH_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_DIRECTION_SEARCH_H_

#include <cstddef>
#include <vector>

#include "core/search/alignment/end_finder.h"
#include "core/search/alignment/end_sampler.h"
#include "core/search/alignment/found_ends.h"
#include "core/search/alignment/node_batch.h"
#include "core/search/alignment/search_inputs.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/should_stop.h"

namespace revisit::core {

template <int D>
class DirectionSearch {
 public:
  DirectionSearch(const SearchInputs<D>& inputs, Direction direction);
  // Its parts refer to each other.
  DirectionSearch(const DirectionSearch&) = delete;
  DirectionSearch& operator=(const DirectionSearch&) = delete;

  // Finds the ends in block k. `next`: the block that will be asked for after
  // it.
  void SearchBlock(std::size_t k, std::size_t next, SearchProgress* progress);

  // Finds the ends in these blocks by samples. Returns false if told to stop.
  // REQUIRES: the inputs have headings, unless there are no blocks.
  bool SampleBlocks(const std::vector<std::size_t>& blocks,
                    const ShouldStop& should_stop, SearchProgress* progress);

  // All that was found, except for what has lower log-odds.
  MatchedEnds HandOver(double least) { return finder_.HandOver(least); }

 private:
  bool SearchLikely(std::vector<KeptEnd> kept, const ShouldStop& should_stop,
                    SearchProgress* progress, std::vector<KeptEnd>* others);
  bool SearchAll(const std::vector<KeptEnd>& kept,
                 const ShouldStop& should_stop, SearchProgress* progress);
  std::size_t SearchKept(const std::vector<KeptEnd>& kept, std::size_t first,
                         SearchProgress* progress);

  const SearchInputs<D>& inputs_;
  const Direction direction_;
  NodeBatch<D> batch_;
  EndSampler<D> sampler_;
  EndFinder<D> finder_;
  // Says which nodes of the batch are sought.
  NodesSought nodes_;
  // Scratch: the nodes to be gathered.
  std::vector<NodeIndex> gathered_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_DIRECTION_SEARCH_H_
