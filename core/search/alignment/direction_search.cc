#include "core/search/alignment/direction_search.h"

#include <algorithm>
#include <functional>
#include <map>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/should_stop.h"

namespace revisit::core {
namespace {

// Ends that are less probable than the best by this share (e^-7) are sampled.
constexpr double kMostLogShareSampled = -7.0;

// Sorts ends so that those come first that may be the best. Ends that may be
// about as good keep their order, which is that of the graph, so that a block
// that is read for one end is at hand for the next. There are few steps.
void SortByLikelihood(std::vector<KeptEnd>* ends) {
  std::map<std::pair<std::size_t, double>, std::vector<KeptEnd>, std::greater<>>
      sorted;
  for (const KeptEnd& end : *ends) {
    sorted[{end.drifts, end.step}].push_back(end);
  }
  ends->clear();
  for (const auto& [key, alike] : sorted) {
    ends->insert(ends->end(), alike.begin(), alike.end());
  }
}

}  // namespace

template <int D>
DirectionSearch<D>::DirectionSearch(const SearchInputs<D>& inputs,
                                    Direction direction)
    : inputs_(inputs),
      direction_(direction),
      batch_(inputs, direction),
      sampler_(inputs, direction, &batch_),
      finder_(inputs, direction, &batch_) {}

template <int D>
void DirectionSearch<D>::SearchBlock(std::size_t k, std::size_t next,
                                     SearchProgress* progress) {
  batch_.TakeBlock(k, next);
  nodes_.sought = SoughtIn(inputs_.history, k);
  nodes_.stands_for.fill(1.0);
  if (inputs_.headings != nullptr) {
    BlockRatios ratios;
    inputs_.headings->Bound(k, direction_, &ratios);
    std::copy(ratios.begin(), ratios.end(), nodes_.gains.begin());
  } else {
    nodes_.gains.fill(inputs_.recent.most_log_likelihood_ratio());
  }
  finder_.Find(nodes_, progress);
}

template <int D>
bool DirectionSearch<D>::SampleBlocks(const std::vector<std::size_t>& blocks,
                                      const ShouldStop& should_stop,
                                      SearchProgress* progress) {
  if (!sampler_.Sample(blocks, should_stop, progress)) return false;
  std::vector<KeptEnd> others;
  if (!SearchLikely(sampler_.TakeKept(), should_stop, progress, &others)) {
    return false;
  }
  const double least = inputs_.model.least_log_share + progress->greatest();
  return SearchAll(SampledAmong(std::move(others), least, progress),
                   should_stop, progress);
}

// Finds the ends that were kept, those first that may be the best. Once the
// others can only be so much less probable than the best that was found, they
// are left. Returns false if told to stop.
template <int D>
bool DirectionSearch<D>::SearchLikely(std::vector<KeptEnd> kept,
                                      const ShouldStop& should_stop,
                                      SearchProgress* progress,
                                      std::vector<KeptEnd>* others) {
  SortByLikelihood(&kept);
  std::size_t last = 0;
  for (std::size_t first = 0; first < kept.size(); first = last) {
    if (should_stop && should_stop()) return false;
    const double sampled = kMostLogShareSampled + progress->greatest();
    if (kAboutAsGood * (kept[first].step + 1.0) < sampled) {
      last = first;
      while (last < kept.size() && kept[last].drifts == kept[first].drifts) {
        others->push_back(kept[last++]);
      }
      continue;
    }
    last = SearchKept(kept, first, progress);
  }
  return true;
}

// Finds all ends that were kept. Returns false if told to stop.
template <int D>
bool DirectionSearch<D>::SearchAll(const std::vector<KeptEnd>& kept,
                                   const ShouldStop& should_stop,
                                   SearchProgress* progress) {
  std::size_t last = 0;
  for (std::size_t first = 0; first < kept.size(); first = last) {
    if (should_stop && should_stop()) return false;
    last = SearchKept(kept, first, progress);
  }
  return true;
}

// Finds those ends of some that were kept which begin at `first` and have the
// same drifts, as many as the batch can take. Returns where the next ones
// begin.
template <int D>
std::size_t DirectionSearch<D>::SearchKept(const std::vector<KeptEnd>& kept,
                                           std::size_t first,
                                           SearchProgress* progress) {
  gathered_.clear();
  std::size_t last = first;
  for (; last < kept.size() && last - first < NodeBlock::kSize &&
         kept[last].drifts == kept[first].drifts;
       ++last) {
    gathered_.push_back(kept[last].node);
  }
  batch_.Gather(gathered_.data(), gathered_.size());
  for (std::size_t i = 0; i < gathered_.size(); ++i) {
    nodes_.gains[i] = kept[first + i].ratio;
    nodes_.stands_for[i] = kept[first + i].nodes;
  }
  nodes_.sought.set();
  finder_.Find(nodes_, progress);
  return last;
}

template class DirectionSearch<3>;
template class DirectionSearch<4>;

}  // namespace revisit::core
