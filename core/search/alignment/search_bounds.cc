#include "core/search/alignment/search_bounds.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "core/drive/block_growth.h"
#include "core/drive/frame_relation.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"

namespace revisit::core {
namespace {

// Error of the difference of two variances due to rounding, as a share of
// these.
constexpr double kCancelled = 1e-12;

}  // namespace

std::size_t StrideOf(NodeIndex nodes) {
  std::size_t stride = kLeastStride;
  while (stride<NodeBlock::kSize&& static_cast<std::size_t>(nodes) / stride>
             kEnoughSamples) {
    stride *= 2;
  }
  return stride;
}

// With s the shift of an end, Q the sum of its path's squared innovations, E
// the filter's EndShift(), and L(s) the log-similarity of the end once changed,
//
//   log-odds <= L(s) + constant + w (surprises of its path - Q / 2).
//
// Since Q >= s^T E^-1 s, half of the innovations' cost pays for the shift:
//
//   w Q / 4 >= 1/2 s^T B^-1 s with B = (2 / w) E,
//
// and the maximum of L(s) - 1/2 s^T B^-1 s over s bounds what the shift can
// gain. The other half, w Q / 4, stays with the path (Walkers::kNeeded).
template <int D>
SearchBounds<D>::SearchBounds(const Query& query, const History& history,
                              const RelativeModel& model,
                              const RecentPath<D>& recent,
                              const PathAxes<D>& axes)
    : query_(query),
      history_(history),
      model_(model),
      recent_(recent),
      axes_(axes),
      constant_(LogNewPlaceTerm(model) - recent.filter().join_cost() -
                model.log_chance),
      stride_(StrideOf(history.size())) {}

// The difference d_i of an end i near j is d_j + s, with s as far as the two
// are apart. With the covariance B of neighbours, which is greater than that,
//
//   d_i^T G^-1 d_i >= d_j^T (G + B)^-1 d_j - s^T B^-1 s.
template <int D>
void SearchBounds<D>::BoundEnds(const ChangeBound& change, BoundOf of,
                                const DifferenceBlock& differences,
                                const BlockSimilarity& similarity,
                                BlockColumn* most,
                                BlockColumn* unshifted) const {
  constexpr double kNothingKnown = std::numeric_limits<double>::infinity();
  if (model_.least_log_share == kImpossible) {
    most->fill(kNothingKnown);
    unshifted->fill(kNothingKnown);
    return;
  }
  BoundChanged(model_.similarity.state_space, differences, change, similarity,
               most, of == BoundOf::kEnd ? unshifted : nullptr);
  const double beside =
      constant_ + kBoundSlack + (of == BoundOf::kEnd ? 0.0 : kAroundSlack);
  for (double& bound : *most) {
    bound += beside;
    // Written so that a bound which is not a number becomes kNothingKnown.
    bound = bound <= kNothingKnown ? bound : kNothingKnown;
  }
}

template <int D>
void SearchBounds<D>::BoundAnywhere(const BlockSimilarity& similarity,
                                    BlockColumn* most,
                                    BlockColumn* unshifted) const {
  const bool is_bounded = model_.least_log_share != kImpossible;
  for (std::size_t i = 0; i < most->size(); ++i) {
    const double log_similarity = is_bounded
                                      ? similarity.log_similarity[i]
                                      : std::numeric_limits<double>::infinity();
    (*most)[i] = log_similarity + constant_ + kBoundSlack;
    (*unshifted)[i] = log_similarity;
  }
}

template <int D>
auto SearchBounds<D>::BlocksToSearch() const -> Blocks {
  std::vector<std::size_t> order;
  const std::optional<Regions> regions = FindRegions();
  const std::size_t begin =
      static_cast<std::size_t>(history_.first) / NodeBlock::kSize;
  const std::size_t all = BlocksOf(history_.end);
  if (regions) {
    for (std::size_t k = all; k-- > regions->last;) order.push_back(k);
    AddNear(*regions, &order);
    for (std::size_t k = regions->first; k-- > begin;) order.push_back(k);
    SortByDistance(&order);
  } else {
    for (std::size_t k = all; k-- > begin;) order.push_back(k);
  }
  Blocks blocks;
  const std::size_t sampled = SamplesEnds() ? BlocksBefore() : 0;
  for (const std::size_t k : order) {
    (FirstBlock() <= k && k < sampled ? blocks.sampled : blocks.all)
        .push_back(k);
  }
  return blocks;
}

template <int D>
bool SearchBounds<D>::SamplesEnds() const {
  return model_.most_log_odds_sampled != kImpossible &&
         model_.similarity.correlation.noise().neighbours_err_alike;
}

// Adds the blocks that lie near under any part of the mixture, those of which
// nothing is known, and those that a drift reaches into, where ends may lie
// elsewhere.
template <int D>
void SearchBounds<D>::AddNear(const Regions& regions,
                              std::vector<std::size_t>* blocks) const {
  const auto begin = static_cast<std::ptrdiff_t>(blocks->size());
  blocks->insert(blocks->end(), regions.always.begin(), regions.always.end());
  for (const Region& region : regions.regions) {
    history_.block_bounds->VisitNear(
        region.of_blocks, region.first, region.last, [&](std::size_t k) {
          if (HoldsNear(region.of_nodes, history_.graph.block(k))) {
            blocks->push_back(k);
          }
        });
  }
  for (const WeighedDrift& drift : DriftsIn(history_, model_.drifts)) {
    const auto block_of = [](NodeIndex i) {
      return static_cast<std::size_t>(std::max<NodeIndex>(i, 0)) /
             NodeBlock::kSize;
    };
    const std::size_t last =
        std::min(regions.last, block_of(drift.reach.last - 1) + 1);
    for (std::size_t k = std::max(regions.first, block_of(drift.reach.first));
         k < last; ++k) {
      blocks->push_back(k);
    }
  }
  std::sort(blocks->begin() + begin, blocks->end());
  blocks->erase(std::unique(blocks->begin() + begin, blocks->end()),
                blocks->end());
}

// Sorts by the distance of the query from one node of each block.
template <int D>
void SearchBounds<D>::SortByDistance(std::vector<std::size_t>* blocks) const {
  const Pose query =
      history_.relation.InHistory(query_.graph.pose(query_.node));
  std::vector<std::pair<double, std::size_t>> order;
  order.reserve(blocks->size());
  for (const std::size_t k : *blocks) {
    const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
    constexpr auto kMiddle = static_cast<NodeIndex>(NodeBlock::kSize / 2);
    const Pose pose = history_.graph.pose(
        std::max(history_.first, std::min(first + kMiddle, history_.end - 1)));
    order.emplace_back(std::hypot(pose.x - query.x, pose.y - query.y), k);
  }
  std::sort(order.begin(), order.end());
  for (std::size_t i = 0; i < order.size(); ++i) {
    (*blocks)[i] = order[i].second;
  }
}

template <int D>
auto SearchBounds<D>::FindRegions() const -> std::optional<Regions> {
  const BlockBounds* const block_bounds = history_.block_bounds;
  if (model_.least_log_share == kImpossible || block_bounds == nullptr) {
    return std::nullopt;
  }
  const Relation& relation = history_.relation;
  if (relation.is_own()) {
    // A loop closure's drift moves the ends elsewhere, and without a closed
    // form errors may be correlated in any way.
    if (!model_.similarity.correlation.noise().has_closed_form() ||
        model_.last_confirmed) {
      return std::nullopt;
    }
  } else if (!relation.tie().is_tied()) {
    return std::nullopt;
  }
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(model_.similarity.tolerance, &tolerance);
  const std::optional<double> log_determinant = LeastLogDeterminant(tolerance);
  if (!log_determinant) return std::nullopt;
  Regions regions;
  regions.first = FirstBlock();
  regions.last = std::min(block_bounds->size(), BlocksBefore());
  if (regions.first >= regions.last || !ErrorsGrow(&regions)) {
    return std::nullopt;
  }
  if (relation.is_own()) {
    AddOwnRegions(tolerance(0, 0), *log_determinant, &regions);
  } else {
    AddTiedRegions(tolerance(0, 0), *log_determinant, &regions);
  }
  return regions;
}

// Leaves out the blocks in which it cannot be shown that Gamma is positive
// definite. Returns whether any are left.
template <int D>
bool SearchBounds<D>::ErrorsGrow(Regions* regions) const {
  if (model_.similarity.correlation.noise().form != DifferenceForm::kGrown) {
    return true;
  }
  const Relation& relation = history_.relation;
  if (relation.is_own()) {
    regions->first = std::max(
        regions->first,
        relation.FirstGrowing(query_, *history_.block_bounds, regions->last));
    return regions->first < regions->last;
  }
  const std::optional<NodeIndex> reference = relation.tie().asking_node;
  if (history_.growing == nullptr ||
      (reference && *reference != query_.node &&
       !NoiseIsAdded(model_.similarity.state_space, query_.graph,
                     std::min(*reference, query_.node),
                     std::max(*reference, query_.node)))) {
    return false;
  }
  for (std::size_t k = regions->first; k < regions->last; ++k) {
    if (k >= history_.growing->size() || !(*history_.growing)[k]) {
      regions->always.push_back(k);
    }
  }
  return true;
}

template <int D>
void SearchBounds<D>::AddOwnRegions(double position_variance,
                                    double log_determinant,
                                    Regions* regions) const {
  const bool is_taken =
      model_.similarity.correlation.noise().form == DifferenceForm::kGrown;
  const Covariance covariance = query_.graph.covariance(query_.node);
  const auto add = [&](const WeighedScale& scale) {
    const double inflation = model_.similarity.inflation * scale.scale;
    const double claimed = inflation * inflation;
    const Along along{claimed * covariance(0, 0), claimed * covariance(0, 1),
                      claimed * covariance(1, 1),
                      is_taken ? -claimed : claimed};
    Region region = RegionOf(along, scale.log_weight,
                             std::max<std::size_t>(1, model_.scales.size()),
                             position_variance, log_determinant);
    region.first = regions->first;
    region.last = regions->last;
    regions->regions.push_back(region);
  };
  if (model_.scales.empty()) add({});
  for (const WeighedScale& scale : model_.scales) add(scale);
}

// With the lever arm of L M L^T at the query's own place (frame_relation.h).
template <int D>
void SearchBounds<D>::AddTiedRegions(double position_variance,
                                     double log_determinant,
                                     Regions* regions) const {
  const Relation& relation = history_.relation;
  const std::vector<FrameWay>& ways = relation.ways();
  const std::size_t parts =
      std::max<std::size_t>(1, model_.scales.size()) * ways.size();
  const auto add = [&](const WeighedScale& scale, const FrameWay& way) {
    const FramePair<D> pair(relation.frames(), relation.tie(), query_.node,
                            model_.similarity.inflation * scale.scale,
                            way.fixed_scale);
    const std::size_t reference =
        std::clamp(BlocksOf(pair.reference()), regions->first, regions->last);
    const auto add_part = [&](bool is_before, std::size_t first,
                              std::size_t last) {
      if (first == last) return;
      const StateMatrix<D> own =
          pair.own() +
          Swung<D>(pair.swung(is_before), pair.place(), pair.query());
      Region region = RegionOf(
          {own(0, 0), own(0, 1), own(1, 1), pair.node_scale(is_before)},
          scale.log_weight + way.log_weight, parts, position_variance,
          log_determinant);
      region.first = first;
      region.last = last;
      regions->regions.push_back(region);
    };
    // The block that holds the reference has nodes of both.
    const std::size_t mixed =
        pair.reference() % static_cast<NodeIndex>(NodeBlock::kSize) != 0 &&
                reference > regions->first
            ? reference - 1
            : reference;
    add_part(/*is_before=*/true, regions->first, reference);
    add_part(/*is_before=*/false, mixed, regions->last);
  };
  for (const FrameWay& way : ways) {
    if (model_.scales.empty()) add({}, way);
    for (const WeighedScale& scale : model_.scales) add(scale, way);
  }
}

// With u the direction from a node to the query in x and y, r their distance,
// G = Gamma + R, V = u^T G u, a the shift in x and y, and l the greatest
// variance of the shift:
//
//   (d + a)^T G^-1 (d + a) >= (u (d + a))^2 / V >= (r - |a|)^2 / V,
//
// and the innovations' cost pays w |a|^2 / l for the shift. The sum of the two,
// over all a, is at least r^2 / (V + l / w). For dead reckoning the lever arm
// is at right angles to u, so that u^T Gamma u = u^T (S_q - S_j) u. Where Gamma
// is positive definite, |G - A| is at least |R - A|, A the most that a path
// takes from the covariance. So an end has the least log-odds only if
//
//   r^2 <= 2 (constant - 1/2 ln|R - A| + w most_log_likelihood_ratio
//             - least log-odds) (V + l / w).
//
// For a whole block V is bounded in any direction; for a single node it is
// known. In a mixture, some part must come to the least log-odds divided by
// the number of parts.
template <int D>
auto SearchBounds<D>::RegionOf(const Along& along, double log_weight,
                               std::size_t parts, double position_variance,
                               double log_determinant) const -> Region {
  const StateMatrix<D>& shift = recent_.filter().EndShift();
  const Pose query =
      history_.relation.InHistory(query_.graph.pose(query_.node));
  // R + l / w.
  const double of_neither =
      position_variance +
      VariancesInAnyDirection(shift(0, 0), shift(0, 1), shift(1, 1)).most /
          recent_.weight();
  Region region;
  BlockBounds::Region& of_blocks = region.of_blocks;
  of_blocks.x = query.x;
  of_blocks.y = query.y;
  of_blocks.variance =
      VariancesInAnyDirection(along.xx, along.xy, along.yy).most + of_neither;
  of_blocks.squared_per_variance =
      2.0 * (constant_ - 0.5 * log_determinant +
             recent_.weight() * recent_.most_log_likelihood_ratio() +
             kBoundSlack + log_weight + std::log(static_cast<double>(parts)) -
             model_.least_log_share);
  (along.node_scale < 0.0 ? of_blocks.least_taken : of_blocks.most_added) =
      std::abs(along.node_scale);
  NodeRegion& of_nodes = region.of_nodes;
  of_nodes.x = query.x;
  of_nodes.y = query.y;
  of_nodes.squared_per_variance = of_blocks.squared_per_variance;
  of_nodes.variance = of_neither + kCancelled * of_blocks.variance;
  of_nodes.xx = along.xx;
  of_nodes.xy = along.xy;
  of_nodes.yy = along.yy;
  of_nodes.node_scale = along.node_scale;
  return region;
}

// The least ln|R - A|. Where R - A is not positive definite, a path takes no
// more than all but kLeastUncertaintyLeft. Nothing if R is not either.
template <int D>
std::optional<double> SearchBounds<D>::LeastLogDeterminant(
    const StateMatrix<D>& tolerance) const {
  const StateVector<D> zero = StateVector<D>::Zero();
  const StateMatrix<D> left =
      (1.0 - kLeastUncertaintyLeft) * tolerance - axes_.MostCertainty();
  if (const auto terms = Evaluate<D>(left, zero)) return terms->log_determinant;
  if (const auto whole = Evaluate<D>(tolerance, zero)) {
    return whole->log_determinant + D * std::log(kLeastUncertaintyLeft);
  }
  return std::nullopt;
}

template class SearchBounds<3>;
template class SearchBounds<4>;

}  // namespace revisit::core
