// Samples the ends of whole blocks where drift fills the town (relative.h):
// decides which of their nodes are to be looked at one by one, and which only
// through one that stands for them.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_END_SAMPLER_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_END_SAMPLER_H_

#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/heading_kernel.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/node_batch.h"
#include "core/search/alignment/search_inputs.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/similarity_kernel.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/should_stop.h"

namespace revisit::core {

// Steps of log-odds in which ends are looked at.
inline constexpr double kAboutAsGood = 2.0;

// An end that is to be looked at by itself.
struct KeptEnd {
  NodeIndex node = 0;
  // The most that the log-likelihood ratio of its path can come to.
  float ratio = 0.0F;
  // The most that its log-odds can come to, and in how many whole steps of
  // kAboutAsGood.
  double most = 0.0;
  double step = 0.0;
  // For how many nodes it stands.
  double nodes = 1.0;
  // Which drifts reach into its block, as bits.
  std::size_t drifts = 0;
};

// One of every kLeastStride of these ends that may come to the least log-odds;
// it stands for them. Those into whose blocks the same drifts reach stay
// together, in the order of the graph.
std::vector<KeptEnd> SampledAmong(std::vector<KeptEnd> ends, double least,
                                  SearchProgress* progress);

template <int D>
class EndSampler {
 public:
  // The batch takes the samples, and must outlive this.
  EndSampler(const SearchInputs<D>& inputs, Direction direction,
             NodeBatch<D>* batch);

  // Samples the ends in these blocks. Returns false if told to stop. REQUIRES:
  // the inputs have headings, unless there are no blocks.
  bool Sample(std::vector<std::size_t> blocks, const ShouldStop& should_stop,
              SearchProgress* progress);

  // The ends that were kept since the last call: those into whose blocks the
  // same drifts reach together, in the order of the graph.
  std::vector<KeptEnd> TakeKept() { return std::exchange(kept_, {}); }

 private:
  // A sample: where it stands among those of its block, and in the batch.
  struct Sampled {
    std::size_t block = 0;
    std::size_t number = 0;
    std::size_t at = 0;
    // The greatest ratio of nodes around it with which they come to no more
    // than what is sampled. Nothing where each of them is looked at.
    std::optional<double> most_sampled;
  };

  std::size_t DriftsInto(std::size_t block) const;
  void SampleTogether(const std::size_t* blocks, std::size_t count,
                      SearchProgress* progress);
  void SampleAround(const Sampled& sample, const BlockNodes& sought,
                    const BlockRatios& ratios, double least,
                    SearchProgress* progress);
  std::optional<double> MostSampled(const Sampled& sample) const;
  bool IsEven(const Sampled& sample) const;

  const SearchInputs<D>& inputs_;
  const Direction direction_;
  // One end in so many is a sample.
  const std::size_t stride_;
  const std::size_t samples_of_block_;
  NodeBatch<D>& batch_;
  std::vector<NodeIndex> samples_;
  // The most that the log-odds of ends around each sample can come to.
  BlockColumn most_;
  std::vector<KeptEnd> kept_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_END_SAMPLER_H_
