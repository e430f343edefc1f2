#include "core/search/alignment/end_finder.h"

#include <algorithm>

#include "core/geometry/state_matrix.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/search_bounds.h"

namespace revisit::core {
namespace {

std::size_t ScalesTold(const RelativeModel& model) {
  return model.tell_scales ? std::max<std::size_t>(1, model.scales.size()) : 0;
}

}  // namespace

template <int D>
EndFinder<D>::EndFinder(const SearchInputs<D>& inputs, Direction direction,
                        NodeBatch<D>* batch)
    : inputs_(inputs),
      weight_(inputs.recent.weight()),
      constant_(inputs.bounds.constant()),
      batch_(*batch),
      walk_(inputs.history, inputs.recent, inputs.axes, direction,
            inputs.model.over_loops, inputs.table,
            inputs.walked == nullptr ? nullptr
                                     : &(*inputs.walked)[IndexOf(direction)]),
      found_(ScalesTold(inputs.model)) {}

template <int D>
void EndFinder<D>::Find(const NodesSought& nodes, SearchProgress* progress) {
  const double least = inputs_.model.least_log_share + progress->greatest();
  const BlockNodes useful = FindUseful(nodes, least, progress);
  if (useful.none()) return;
  const BestPaths& paths = WalkBack(useful, nodes.gains, least);
  batch_.anchors().Change(paths.change);
  Collect(useful, nodes.stands_for, least, paths, progress);
}

// The nodes that may come to the least log-odds.
template <int D>
BlockNodes EndFinder<D>::FindUseful(const NodesSought& nodes, double least,
                                    SearchProgress* progress) {
  batch_.anchors().Bound(inputs_.bounds, BoundOf::kEnd, &most_);
  BlockNodes useful;
  for (std::size_t i = 0; i < batch_.size(); ++i) {
    most_[i] += weight_ * nodes.gains[i];
    if (!nodes.sought[i] || !batch_.anchors().IsPossible(i)) {
      progress->Consider(batch_.node(i));
    } else if (!(most_[i] < least)) {
      useful.set(i);
      progress->Consider(batch_.node(i));
    }
  }
  return useful;
}

template <int D>
const BestPaths& EndFinder<D>::WalkBack(const BlockNodes& useful,
                                        const BlockColumn& gains,
                                        double least) {
  starts_.clear();
  for (std::size_t i = 0; i < batch_.size(); ++i) {
    if (!useful[i]) continue;
    // The ratio of a path without any innovation, less the ratio by which the
    // end's bound exceeds the least log-odds.
    starts_.push_back(
        {batch_.node(i), gains[i] - (most_[i] - least) / weight_, i});
  }
  return walk_.Walk(
      starts_, inputs_.model.least_log_share == kImpossible
                   ? typename PathWalk<D>::IsUseless()
                   : [this, least](const PathSoFar<D>& path) {
                       return IsUseless(path, least);
                     });
}

// Whether a path comes to less than the least log-odds, as it was when it was
// best and however it goes on.
template <int D>
bool EndFinder<D>::IsUseless(const PathSoFar<D>& path, double least) {
  const double beside = constant_ + kBoundSlack;
  const auto falls_short = [&](const StateVector<D>& shift,
                               std::optional<std::int64_t> steps,
                               double ratio) {
    return !batch_.anchors().MayReach(path.slot, shift, steps,
                                      least - (weight_ * ratio + beside));
  };
  return falls_short(path.shift, path.steps, path.most_ratio) &&
         falls_short(path.best_shift, std::nullopt, path.best_ratio);
}

// Keeps the useful ends that have come to the least log-odds.
template <int D>
void EndFinder<D>::Collect(const BlockNodes& useful,
                           const BlockColumn& stands_for, double least,
                           const BestPaths& paths, SearchProgress* progress) {
  for (std::size_t i = batch_.size(); i-- > 0;) {
    if (!useful[i]) continue;
    const auto anchor = batch_.anchors().At(i);
    const double beside = weight_ * paths.log_likelihood_ratios[i] + constant_;
    const double score = anchor.log_similarity + beside;
    if (!(score >= least)) continue;
    progress->Found(score);
    found_.Add({batch_.node(i), score, stands_for[i]},
               {paths.log_likelihood_ratios[i], paths.squared_innovations[i],
                anchor.squared_mahalanobis, anchor.scale, paths.change.row[i],
                anchor.way});
    if (!inputs_.model.tell_scales) continue;
    std::vector<double>& odds = *found_.odds_by_scale();
    const auto first = static_cast<std::ptrdiff_t>(odds.size());
    batch_.anchors().AppendScales(i, &odds);
    std::for_each(odds.begin() + first, odds.end(),
                  [beside](double& of_scale) { of_scale += beside; });
  }
}

template class EndFinder<3>;
template class EndFinder<4>;

}  // namespace revisit::core
