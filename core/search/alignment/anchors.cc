#include "core/search/alignment/anchors.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>

#include "core/drive/confirmed_loop.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

bool Reaches(const WeighedDrift& drift, NodeIndex first) {
  return drift.reach.first < first + static_cast<NodeIndex>(NodeBlock::kSize) &&
         first < drift.reach.last;
}

template <int D>
Anchors<D>::Anchors(const Query& query, const History& history,
                    const RelativeModel& model, Direction direction)
    : model_(model) {
  SimilarityModel similarity = model.similarity;
  similarity.direction = direction;
  similarity.form = LikelihoodForm::kGaussian;
  parts_.reserve(std::max<std::size_t>(1, model.scales.size()) *
                 (1 + model.drifts.size()));
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
  const auto add = [&](const std::optional<ConfirmedLoop>& loop,
                       const WeighedDrift* drift) {
    Part& part = parts_.emplace_back(query, history, scaled, loop);
    part.scale = scale.scale;
    part.log_scale_weight = scale.log_weight;
    part.drift = drift;
  };
  add(model_.last_confirmed, nullptr);
  for (const WeighedDrift& drift : model_.drifts) add(drift.loop, &drift);
}

// Gives each part its weight in the block that begins at node `first`.
template <int D>
void Anchors<D>::Weigh(NodeIndex first) {
  double left = 1.0;
  for (const WeighedDrift& drift : model_.drifts) {
    if (Reaches(drift, first)) left -= std::exp(drift.log_weight);
  }
  for (Part& part : parts_) {
    part.counts = part.drift == nullptr || Reaches(*part.drift, first);
    part.log_weight =
        part.log_scale_weight +
        (part.drift == nullptr ? std::log(left) : part.drift->log_weight);
  }
}

template <int D>
void Anchors<D>::Find(std::size_t k, std::size_t count, std::size_t next) {
  count_ = count;
  Weigh(static_cast<NodeIndex>(k * NodeBlock::kSize));
  for (Part& part : parts_) {
    if (!part.counts) continue;
    part.finder.Find(k, count, next, &part.differences);
    EvaluateDifferences(model_.similarity.state_space, part.differences,
                        &part.similarity);
  }
}

template <int D>
void Anchors<D>::FindAmong(const NodeBlock& nodes, const BlockColumn& indices,
                           std::size_t count, NodeIndex first) {
  count_ = count;
  Weigh(first);
  for (Part& part : parts_) {
    if (!part.counts) continue;
    part.finder.FindAmong(nodes, indices, count, &part.differences);
    EvaluateDifferences(model_.similarity.state_space, part.differences,
                        &part.similarity);
  }
}

template <int D>
bool Anchors<D>::IsPossible(std::size_t i) const {
  return std::any_of(parts_.begin(), parts_.end(), [i](const Part& part) {
    return part.counts && part.similarity.log_similarity[i] != kImpossible;
  });
}

// The claimed covariances are the same in all parts, whatever their scales and
// drifts, so the first part is asked.
template <int D>
bool Anchors<D>::AreAlike(std::size_t i, std::size_t j) const {
  const DifferenceBlock& differences = parts_.front().differences;
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
    bounds.BoundEnds(part.differences, part.similarity, of, &of_part,
                     &part.unshifted);
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

// With d the difference as it is shifted, G its covariance and A what a path
// takes from that,
//
//   (d + s)^T (G - A)^-1 (d + s) + s^T B^-1 s >= d^T (G + B)^-1 d.
template <int D>
double Anchors<D>::BoundShifted(std::size_t i, const StateVector<D>& shift,
                                const double* further) const {
  double most = kImpossible;
  double counting = 0.0;
  for (const Part& part : parts_) {
    if (!part.counts || part.similarity.log_similarity[i] == kImpossible) {
      continue;
    }
    // L^-1 d, by the factors L D L^T of G + B, row by row.
    double lower[D][D];
    double pivots[D];
    double solved[D];
    double squared = 0.0;
    std::size_t entry = 0;
    for (int r = 0; r < D; ++r) {
      solved[r] = part.differences.difference[static_cast<std::size_t>(r)][i] +
                  shift(r);
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
      if (!(pivots[r] > 0.0)) return std::numeric_limits<double>::infinity();
      squared += solved[r] * solved[r] / pivots[r];
    }
    most = std::max(most, part.log_weight + part.unshifted[i] - 0.5 * squared);
    counting += 1.0;
  }
  return counting == 1.0 ? most : most + std::log(counting);
}

template <int D>
void Anchors<D>::Change(const DifferenceChange& change) {
  for (Part& part : parts_) {
    if (!part.counts) continue;
    EvaluateChanged(model_.similarity.state_space, part.differences, change,
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
    mixture = {weighed, part.similarity.squared_mahalanobis[i], part.scale};
  }
  // The sum is e^0 then.
  if (parts_.size() == 1 && mixture.log_similarity != kImpossible) {
    return mixture;
  }
  double sum = 0.0;
  for (const Part& part : parts_) {
    if (!part.counts) continue;
    sum += std::exp(part.similarity.log_similarity[i] + part.log_weight -
                    mixture.log_similarity);
  }
  mixture.log_similarity += std::log(sum);
  return mixture;
}

template <int D>
void Anchors<D>::AppendScales(std::size_t i,
                              std::vector<double>* log_similarities) const {
  assert(model_.drifts.empty());
  for (const Part& part : parts_) {
    log_similarities->push_back(part.similarity.log_similarity[i]);
  }
}

template class Anchors<3>;
template class Anchors<4>;

}  // namespace revisit::core
