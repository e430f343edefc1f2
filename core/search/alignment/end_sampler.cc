#include "core/search/alignment/end_sampler.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <optional>

#include "core/search/alignment/anchors.h"
#include "core/search/alignment/search_bounds.h"
#include "core/search/should_stop.h"

namespace revisit::core {

std::vector<KeptEnd> SampledAmong(std::vector<KeptEnd> ends, double least,
                                  SearchProgress* progress) {
  ends.erase(
      std::remove_if(ends.begin(), ends.end(),
                     [&](const KeptEnd& end) { return end.most < least; }),
      ends.end());
  std::sort(ends.begin(), ends.end(), [](const KeptEnd& a, const KeptEnd& b) {
    return a.drifts != b.drifts ? a.drifts > b.drifts : a.node < b.node;
  });
  std::vector<KeptEnd> samples;
  std::size_t last = 0;
  for (std::size_t first = 0; first < ends.size(); first = last) {
    double nodes = 0.0;
    for (; last < ends.size() && last - first < kLeastStride &&
           ends[last].drifts == ends[first].drifts;
         ++last) {
      progress->Consider(ends[last].node);
      nodes += ends[last].nodes;
    }
    samples.push_back(ends[first + (last - first) / 2]);
    samples.back().nodes = nodes;
  }
  return samples;
}

template <int D>
EndSampler<D>::EndSampler(const SearchInputs<D>& inputs, Direction direction,
                          NodeBatch<D>* batch)
    : inputs_(inputs),
      direction_(direction),
      stride_(inputs.bounds.stride()),
      samples_of_block_(NodeBlock::kSize / stride_),
      batch_(*batch) {}

template <int D>
std::size_t EndSampler<D>::DriftsInto(std::size_t block) const {
  const std::vector<WeighedDrift>& all =
      DriftsIn(inputs_.history, inputs_.model.drifts);
  std::size_t drifts = 0;
  for (std::size_t i = 0; i < all.size(); ++i) {
    drifts |= static_cast<std::size_t>(Reaches(
                  all[i], static_cast<NodeIndex>(block * NodeBlock::kSize)))
              << i;
  }
  return drifts;
}

template <int D>
bool EndSampler<D>::Sample(std::vector<std::size_t> blocks,
                           const ShouldStop& should_stop,
                           SearchProgress* progress) {
  const std::size_t at_a_time = NodeBlock::kSize / samples_of_block_;
  std::sort(blocks.begin(), blocks.end(), [this](std::size_t a, std::size_t b) {
    const std::size_t into_a = DriftsInto(a);
    const std::size_t into_b = DriftsInto(b);
    return into_a != into_b ? into_a > into_b : a < b;
  });
  std::size_t last = 0;
  for (std::size_t first = 0; first < blocks.size(); first = last) {
    if (should_stop && should_stop()) return false;
    const std::size_t drifts = DriftsInto(blocks[first]);
    while (last < blocks.size() && last - first < at_a_time &&
           DriftsInto(blocks[last]) == drifts) {
      ++last;
    }
    SampleTogether(blocks.data() + first, last - first, progress);
  }
  return true;
}

// Samples blocks into which the same drifts reach, as many as the batch has
// room for the samples of.
template <int D>
void EndSampler<D>::SampleTogether(const std::size_t* blocks, std::size_t count,
                                   SearchProgress* progress) {
  samples_.clear();
  for (std::size_t b = 0; b < count; ++b) {
    for (std::size_t i = 0; i < samples_of_block_; ++i) {
      samples_.push_back(static_cast<NodeIndex>(blocks[b] * NodeBlock::kSize +
                                                i * stride_ + stride_ / 2));
    }
  }
  batch_.Gather(samples_.data(), samples_.size());
  batch_.anchors().Bound(inputs_.bounds, BoundOf::kEndsAround, &most_);
  const double least = inputs_.model.least_log_share + progress->greatest();
  BlockRatios ratios;
  for (std::size_t b = 0; b < count; ++b) {
    const BlockNodes sought = SoughtIn(inputs_.history, blocks[b]);
    std::array<Sampled, NodeBlock::kSize / kLeastStride> samples;
    constexpr float kInfinity = std::numeric_limits<float>::infinity();
    // Only what is above one of these has to be known closely. What is told as
    // enough is not above it.
    float enough = kInfinity;
    for (std::size_t i = 0; i < samples_of_block_; ++i) {
      Sampled& sample = samples[i];
      sample = {blocks[b], i, b * samples_of_block_ + i, std::nullopt};
      sample.most_sampled = MostSampled(sample);
      if (!sample.most_sampled) continue;
      enough = std::min(
          enough,
          std::nextafter(static_cast<float>(*sample.most_sampled), -kInfinity));
    }
    inputs_.headings->Bound(blocks[b], direction_, enough, &ratios);
    for (std::size_t i = 0; i < samples_of_block_; ++i) {
      SampleAround(samples[i], sought, ratios, least, progress);
    }
  }
}

// Decides about the nodes around a sample, of which those of its block are told
// that are sought, and the most that each one's ratio can come to.
template <int D>
void EndSampler<D>::SampleAround(const Sampled& sample,
                                 const BlockNodes& sought,
                                 const BlockRatios& ratios, double least,
                                 SearchProgress* progress) {
  const auto first = static_cast<NodeIndex>(sample.block * NodeBlock::kSize);
  const std::size_t begin = sample.number * stride_;
  const double weight = inputs_.recent.weight();
  const double around = most_[sample.at];
  const bool possible = sample.most_sampled.has_value();
  const double kept = sample.most_sampled.value_or(kImpossible);
  // Nodes of which the ratio is so much may come to the least log-odds.
  const double may_be = (least - around) / weight;
  const std::size_t drifts = DriftsInto(sample.block);
  const auto end_at = [&](std::size_t i, double nodes) {
    const double most = possible ? around + weight * ratios[i]
                                 : std::numeric_limits<double>::infinity();
    return KeptEnd{first + static_cast<NodeIndex>(i), ratios[i], most,
                   std::floor(most / kAboutAsGood),   nodes,     drifts};
  };
  // One stands for all that cannot: the sample, unless that can itself.
  double stands_for = 0.0;
  std::size_t standing = NodeBlock::kSize;
  for (std::size_t i = begin; i < begin + stride_; ++i) {
    const NodeIndex node = first + static_cast<NodeIndex>(i);
    if (!sought[i]) {
      progress->Consider(node);
    } else if (!possible || ratios[i] > kept) {
      kept_.push_back(end_at(i, 1.0));
    } else if (!(ratios[i] < may_be)) {
      progress->Consider(node);
      stands_for += 1.0;
      const bool is_sample = i == begin + stride_ / 2;
      if (standing == NodeBlock::kSize || is_sample) standing = i;
    }
  }
  if (standing == NodeBlock::kSize) return;
  const KeptEnd end = end_at(standing, stands_for);
  auto at = kept_.end();
  while (at != kept_.begin() && std::prev(at)->node > end.node &&
         std::prev(at)->node <
             first + static_cast<NodeIndex>(begin + stride_)) {
    --at;
  }
  kept_.insert(at, end);
}

// Sampled::most_sampled.
template <int D>
std::optional<double> EndSampler<D>::MostSampled(const Sampled& sample) const {
  if (!batch_.anchors().IsPossible(sample.at) || !IsEven(sample)) {
    return std::nullopt;
  }
  return (inputs_.model.most_log_odds_sampled - most_[sample.at]) /
         inputs_.recent.weight();
}

// Whether the nodes that a sample stands for lie about where it does, none of
// them beyond a jump, and the covariances of neighbouring samples of a block
// are about as great, and so those of what lies between.
template <int D>
bool EndSampler<D>::IsEven(const Sampled& sample) const {
  const auto first = static_cast<NodeIndex>(sample.block * NodeBlock::kSize +
                                            sample.number * stride_);
  const NodeIndex last = first + static_cast<NodeIndex>(stride_) - 1;
  if (inputs_.history.graph.SegmentStart(last) > first) return false;
  const Anchors<D>& anchors = batch_.anchors();
  const std::size_t at = sample.at;
  return (sample.number == 0 || anchors.AreAlike(at - 1, at)) &&
         (sample.number + 1 == samples_of_block_ ||
          anchors.AreAlike(at, at + 1));
}

template class EndSampler<3>;
template class EndSampler<4>;

}  // namespace revisit::core
