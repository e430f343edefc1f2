#include "core/search/alignment/anchors.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>

#include "core/drive/confirmed_loop.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/exponential_sum.h"
#include "core/search/alignment/shown_drift.h"

namespace revisit::core {

bool Reaches(const WeighedDrift& drift, NodeIndex first) {
  return drift.reach.first < first + static_cast<NodeIndex>(NodeBlock::kSize) &&
         first < drift.reach.last;
}

template <int D>
Anchors<D>::Anchors(const Query& query, const History& history,
                    const RelativeModel& model, const RecentPath<D>& recent,
                    const PathAxes<D>& axes, Direction direction)
    : model_(model),
      recent_(recent),
      axes_(axes),
      drifts_(DriftsIn(history, model.drifts)),
      part_axes_(1) {
  SimilarityModel similarity = model.similarity;
  similarity.direction = direction;
  similarity.form = LikelihoodForm::kGaussian;
  const std::size_t ways =
      history.relation.is_own() ? 1 : history.relation.ways().size();
  parts_.reserve(std::max<std::size_t>(1, model.scales.size()) *
                 (ways + drifts_.size()));
  if (model.scales.empty()) AddParts(query, history, similarity, {});
  for (const WeighedScale& scale : model.scales) {
    AddParts(query, history, similarity, scale);
  }
}

template <int D>
void Anchors<D>::AddParts(const Query& query, const History& history,
                          const SimilarityModel& similarity,
                          const WeighedScale& scale) {
  SimilarityModel scaled = similarity;
  scaled.inflation *= scale.scale;
  if (history.relation.is_own()) {
    AddOwnParts(query, history, scaled, scale);
  } else {
    AddTiedParts(query, history, scaled, scale);
  }
}

template <int D>
void Anchors<D>::AddOwnParts(const Query& query, const History& history,
                             const SimilarityModel& similarity,
                             const WeighedScale& scale) {
  parts_.emplace_back(scale).finder.emplace(query, history, similarity,
                                            model_.last_confirmed);
  for (const WeighedDrift& drift : drifts_) {
    Part& part = parts_.emplace_back(scale);
    part.drift = &drift;
    const auto shown = ShownDrift<D>::Make(query, similarity, drift.pairs);
    if (!shown) {
      part.finder.emplace(query, history, similarity, std::nullopt);
      continue;
    }
    part.finder.emplace(query, history, similarity, *shown);
    TurnAxes(query, shown->tie(), &part);
  }
}

// Lets the part see the path in axes of its own, turned as the tie says.
template <int D>
void Anchors<D>::TurnAxes(const Query& query, const FrameRelation& tie,
                          Part* part) {
  part->heading =
      WrapHeading(query.graph.pose(query.node).heading - tie.transform.heading);
  part->axes = part_axes_.size();
  part_axes_.emplace_back();
}

template <int D>
void Anchors<D>::AddTiedParts(const Query& query, const History& history,
                              const SimilarityModel& similarity,
                              const WeighedScale& scale) {
  const Relation& relation = history.relation;
  const auto add = [&](std::size_t way) -> Part& {
    Part& part = parts_.emplace_back(scale);
    part.way = way;
    return part;
  };
  for (std::size_t i = 0; i < relation.ways().size(); ++i) {
    const FrameWay& way = relation.ways()[i];
    Part& part = add(i);
    part.log_way_weight = way.log_weight;
    if (way.is_unknown) continue;
    part.finder.emplace(query, history, similarity, relation.tie(),
                        way.fixed_scale);
  }
  for (std::size_t i = 0; i < drifts_.size(); ++i) {
    const FrameRelation tie = relation.Shown(drifts_[i], similarity.inflation);
    Part& part = add(relation.ways().size() + i);
    part.drift = &drifts_[i];
    part.finder.emplace(query, history, similarity, tie, 1.0);
    TurnAxes(query, tie, &part);
  }
}

// Gives each part its weight in the block that begins at node `first`.
template <int D>
void Anchors<D>::Weigh(NodeIndex first) {
  double left = 1.0;
  for (const WeighedDrift& drift : drifts_) {
    if (Reaches(drift, first)) left -= std::exp(drift.log_weight);
  }
  for (Part& part : parts_) {
    part.counts = part.drift == nullptr || Reaches(*part.drift, first);
    part.log_weight =
        part.log_scale_weight +
        (part.drift == nullptr ? std::log(left) : part.drift->log_weight);
    // Nothing is added where there is one way.
    if (part.log_way_weight != 0.0) part.log_weight += part.log_way_weight;
  }
  log_counting_ = std::log(static_cast<double>(
      std::count_if(parts_.begin(), parts_.end(),
                    [](const Part& part) { return part.counts; })));
}

template <int D>
void Anchors<D>::Find(std::size_t k, std::size_t count, std::size_t next) {
  count_ = count;
  Weigh(static_cast<NodeIndex>(k * NodeBlock::kSize));
  for (Part& part : parts_) {
    if (!part.counts) continue;
    if (part.finder) part.finder->Find(k, count, next, &part.differences);
    Evaluate(&part);
  }
}

template <int D>
void Anchors<D>::FindAmong(const NodeBlock& nodes, const BlockColumn& indices,
                           std::size_t count, NodeIndex first) {
  count_ = count;
  Weigh(first);
  for (Part& part : parts_) {
    if (!part.counts) continue;
    if (part.finder) {
      part.finder->FindAmong(nodes, indices, count, &part.differences);
    }
    Evaluate(&part);
  }
}

// Where nothing ties the frames, each end is one of as many as the world holds,
// by itself: the constant of the log-odds does not count.
template <int D>
void Anchors<D>::Evaluate(Part* part) {
  if (part->finder) {
    EvaluateDifferences(model_.similarity.state_space, part->differences,
                        &part->similarity);
    return;
  }
  part->similarity.log_similarity.fill(-LogWorldNodes(model_) -
                                       LogNewPlaceTerm(model_));
  part->similarity.squared_mahalanobis.fill(0.0);
}

template <int D>
const PathAxes<D>& Anchors<D>::AxesOf(const Part& part) {
  if (part.axes == 0) return axes_;
  std::unique_ptr<const PathAxes<D>>& own = part_axes_[part.axes].own;
  if (own == nullptr) {
    own = std::make_unique<const PathAxes<D>>(recent_, part.heading,
                                              axes_.apart_meters());
  }
  return *own;
}

template <int D>
bool Anchors<D>::IsPossible(std::size_t i) const {
  return std::any_of(parts_.begin(), parts_.end(), [i](const Part& part) {
    return part.counts && part.similarity.log_similarity[i] != kImpossible;
  });
}

// The claimed covariances are about the same in all parts, whatever their
// scales and drifts, so the first part is asked that looks at them.
template <int D>
bool Anchors<D>::AreAlike(std::size_t i, std::size_t j) const {
  const auto first =
      std::find_if(parts_.begin(), parts_.end(),
                   [](const Part& part) { return part.counts && part.finder; });
  if (first == parts_.end()) return true;
  const DifferenceBlock& differences = first->differences;
  for (int r = 0; r < D; ++r) {
    const BlockColumn& variances =
        differences.covariance[static_cast<std::size_t>(r * (r + 1) / 2 + r)];
    // Written so that NaN is not alike.
    if (!(variances[i] <= 2.0 * variances[j] &&
          variances[j] <= 2.0 * variances[i])) {
      return false;
    }
  }
  return true;
}

// The bounds of the parts are added up: e^-x is at most 1 / (1 + x + x^2 / 2).
template <int D>
void Anchors<D>::Bound(const SearchBounds<D>& bounds, BoundOf of,
                       BlockColumn* most) {
  most->fill(kImpossible);
  part_bounds_.resize(parts_.size());
  std::size_t counting = 0;
  for (Part& part : parts_) {
    if (!part.counts) continue;
    BlockColumn& of_part = part_bounds_[counting++];
    if (part.finder) {
      const PathAxes<D>& axes = AxesOf(part);
      bounds.BoundEnds(
          of == BoundOf::kEnd ? axes.of_end() : axes.of_ends_around(), of,
          part.differences, part.similarity, &of_part, &part.unshifted);
    } else {
      bounds.BoundAnywhere(part.similarity, &of_part, &part.unshifted);
    }
    for (std::size_t i = 0; i < count_; ++i) {
      const bool possible = part.similarity.log_similarity[i] != kImpossible;
      of_part[i] = possible ? of_part[i] + part.log_weight : kImpossible;
      (*most)[i] = std::max((*most)[i], of_part[i]);
    }
  }
  if (counting == 1) return;
  BlockColumn sum;
  sum.fill(0.0);
  for (std::size_t part = 0; part < counting; ++part) {
    for (std::size_t i = 0; i < count_; ++i) {
      const double less = (*most)[i] - part_bounds_[part][i];
      sum[i] += 1.0 / (1.0 + less + 0.5 * less * less);
    }
  }
  for (std::size_t i = 0; i < count_; ++i) {
    // Where nothing is known, nothing is added up.
    if (std::isfinite((*most)[i])) (*most)[i] += std::log(sum[i]);
  }
}

// B of what a path of so many steps may shift an end further, in the axes of
// the part.
template <int D>
const double* Anchors<D>::FurtherShift(const Part& part,
                                       std::optional<std::int64_t> steps) {
  static constexpr double kNoFurther[kMostEntries] = {};
  if (!steps) return kNoFurther;
  const PathAxes<D>& seen = AxesOf(part);
  Axes& axes = part_axes_[part.axes];
  if (axes.further_after != steps) {
    PackLower<D>(seen.FurtherShift(*steps), axes.further);
    axes.further_after = steps;
  }
  return axes.further;
}

// All parts together come to no more than as many times the greatest of them,
// so that one of them has to come to its share: most often the one that did
// for the end before.
template <int D>
bool Anchors<D>::MayReach(std::size_t i, const StateVector<D>& shift,
                          std::optional<std::int64_t> steps, double least) {
  const double share = least - log_counting_;
  if (PartMayReach(parts_[reached_], i, shift, steps, share)) return true;
  for (std::size_t part = 0; part < parts_.size(); ++part) {
    if (part == reached_ ||
        !PartMayReach(parts_[part], i, shift, steps, share)) {
      continue;
    }
    reached_ = part;
    return true;
  }
  return false;
}

// With d the difference as it is shifted, G its covariance and A what a path
// takes from that,
//
//   (d + s)^T (G - A)^-1 (d + s) + s^T B^-1 s >= d^T (G + B)^-1 d.
template <int D>
bool Anchors<D>::PartMayReach(const Part& part, std::size_t i,
                              const StateVector<D>& shift,
                              std::optional<std::int64_t> steps, double least) {
  if (!part.counts || part.similarity.log_similarity[i] == kImpossible) {
    return false;
  }
  // So much is left for the square, which is no less than 0.
  const double left_over = 2.0 * (part.log_weight + part.unshifted[i] - least);
  if (left_over < 0.0) return false;
  if (!part.finder) return true;
  const StateVector<D> turned = AxesOf(part).TurnedShift(shift);
  const double* const further = FurtherShift(part, steps);
  // L^-1 d, by the factors L D L^T of G + B, row by row.
  double lower[D][D];
  double pivots[D];
  double solved[D];
  double squared = 0.0;
  std::size_t entry = 0;
  for (int r = 0; r < D; ++r) {
    solved[r] =
        part.differences.difference[static_cast<std::size_t>(r)][i] + turned(r);
    for (int c = 0; c <= r; ++c, ++entry) {
      double left = part.differences.covariance[entry][i] + further[entry];
      for (int k = 0; k < c; ++k) {
        left -= lower[r][k] * lower[c][k] * pivots[k];
      }
      if (c < r) {
        lower[r][c] = left / pivots[c];
        solved[r] -= lower[r][c] * solved[c];
      } else {
        pivots[r] = left;
      }
    }
    // Written so that NaN is nothing known.
    if (!(pivots[r] > 0.0)) return true;
    squared += solved[r] * solved[r] / pivots[r];
  }
  return !(squared > left_over);
}

// The change comes in the axes of axes_.
template <int D>
void Anchors<D>::Change(const DifferenceChange& change) {
  for (Part& part : parts_) {
    if (!part.counts || !part.finder) continue;
    if (part.axes == 0) {
      EvaluateChanged(model_.similarity.state_space, part.differences, change,
                      &part.similarity);
      continue;
    }
    const PathAxes<D>& axes = AxesOf(part);
    DifferenceChange turned = change;
    turned.certainty = axes.certainties();
    turned.cosine = std::cos(axes.heading());
    turned.sine = std::sin(axes.heading());
    EvaluateChanged(model_.similarity.state_space, part.differences, turned,
                    &part.similarity);
  }
}

template <int D>
auto Anchors<D>::At(std::size_t i) const -> Mixture {
  Mixture mixture;
  for (const Part& part : parts_) {
    if (!part.counts) continue;
    const double weighed = part.similarity.log_similarity[i] + part.log_weight;
    if (!(weighed > mixture.log_similarity)) continue;
    mixture = {weighed, part.similarity.squared_mahalanobis[i], part.scale,
               part.way};
  }
  // The sum is e^0 then.
  if (parts_.size() == 1 && mixture.log_similarity != kImpossible) {
    return mixture;
  }
  ExponentialSum sum;
  for (const Part& part : parts_) {
    if (!part.counts) continue;
    sum.Add(part.similarity.log_similarity[i] + part.log_weight -
            mixture.log_similarity);
  }
  mixture.log_similarity += std::log(sum.value());
  return mixture;
}

template <int D>
void Anchors<D>::AppendScales(std::size_t i,
                              std::vector<double>* log_similarities) const {
  assert(drifts_.empty());
  for (std::size_t first = 0; first < parts_.size();) {
    // The ways of one scale follow each other.
    std::size_t last = first + 1;
    while (last < parts_.size() && parts_[last].way > 0) ++last;
    const auto weighed = [&](std::size_t part) {
      return parts_[part].similarity.log_similarity[i] +
             parts_[part].log_way_weight;
    };
    double greatest = weighed(first);
    for (std::size_t part = first + 1; part < last; ++part) {
      greatest = std::max(greatest, weighed(part));
    }
    double log_sum = greatest;
    if (last - first > 1 && greatest != kImpossible) {
      double sum = 0.0;
      for (std::size_t part = first; part < last; ++part) {
        sum += std::exp(weighed(part) - greatest);
      }
      log_sum += std::log(sum);
    }
    log_similarities->push_back(log_sum);
    first = last;
  }
}

template class Anchors<3>;
template class Anchors<4>;

}  // namespace revisit::core
