#include "core/search/alignment/far_histories.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/block_growth.h"
#include "core/drive/frame_relation.h"
#include "core/drive/node_extent.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/search_bounds.h"

namespace revisit::core {
namespace {

// Beyond the bounds that they are compared with, those that are found here are
// greater by this, nats, and by this share: for rounding, there and here.
constexpr double kAside = 0.1;
constexpr double kAsideShare = 1e-4;

// A covariance is taken for well-conditioned if each tolerance is at least this
// share of what it is added to: no pivot is less than the tolerance.
constexpr double kLeastToleratedShare = 100.0 * kPivotTolerance;

// The most that -1/2 ln|G - A| can come to, with G at least R; nothing where R
// is not well-conditioned.
template <int D>
std::optional<double> MostOfDeterminant(const StateMatrix<D>& tolerance,
                                        const StateMatrix<D>& certainty) {
  const StateVector<D> zero = StateVector<D>::Zero();
  const auto whole = Evaluate<D>(tolerance, zero);
  if (!whole) return std::nullopt;
  double least = whole->log_determinant + D * std::log(kLeastUncertaintyLeft);
  const StateMatrix<D> left =
      (1.0 - kLeastUncertaintyLeft) * tolerance - certainty;
  if (const auto terms = Evaluate<D>(left, zero)) {
    least = std::min(least, terms->log_determinant);
  }
  return -0.5 * least;
}

// The farthest that a coordinate of a stretch of nodes is from `at`.
double Farthest(double least, double most, double at) {
  return std::max(std::abs(least - at), std::abs(most - at));
}

}  // namespace

class FarHistories::Test {
 public:
  virtual ~Test() = default;
  virtual bool IsFar(const History& history) = 0;
};

template <int D>
class FarHistories::TestIn : public Test {
 public:
  TestIn(const Query& query, const RelativeModel& model,
         const RecentPath<D>& recent)
      : query_(query), model_(model), shift_(ShiftOf(recent)) {
    tolerance_.setZero();
    AddTolerance<D>(model.similarity.tolerance, &tolerance_);
    const auto of_determinant = MostOfDeterminant<D>(
        tolerance_, recent.filter().EndCertainty(recent.size() - 1));
    if (!of_determinant) return;
    most_log_odds_ =
        LogNewPlaceTerm(model) - recent.filter().join_cost() + kAroundSlack +
        recent.weight() * recent.most_log_likelihood_ratio() + *of_determinant;
    if (model.scales.empty()) {
      greatest_scale_ = 1.0;
      most_log_weight_ = 0.0;
    }
    for (const WeighedScale& scale : model.scales) {
      greatest_scale_ = std::max(greatest_scale_, scale.scale);
      most_log_weight_ = std::max(most_log_weight_, scale.log_weight);
    }
  }

  bool IsFar(const History& history) override {
    const Relation& relation = history.relation;
    if (history.extents == nullptr || !most_log_odds_ || relation.is_own() ||
        !relation.tie().is_tied() || !relation.drifts().empty() ||
        !ErrorsGrow(history)) {
      return false;
    }
    // Variances grow with the scale of what the poses between the frames have
    // added, as far as that is more than nothing in every direction.
    const bool is_monotone = relation.tie().drift.isZero(0.0);
    for (const FrameWay& way : relation.ways()) {
      if (model_.scales.empty() || is_monotone) {
        if (!IsFar(history, way, greatest_scale_, most_log_weight_)) {
          return false;
        }
        continue;
      }
      for (const WeighedScale& scale : model_.scales) {
        if (!IsFar(history, way, scale.scale, scale.log_weight)) return false;
      }
    }
    return true;
  }

 private:
  static StateMatrix<D> ShiftOf(const RecentPath<D>& recent) {
    return (2.0 / recent.weight()) * recent.filter().EndShift();
  }

  // Whether Gamma is positive definite, or at least no negative variance, at
  // all nodes.
  bool ErrorsGrow(const History& history) {
    if (model_.similarity.correlation.noise().form != DifferenceForm::kGrown) {
      return true;
    }
    const std::optional<NodeIndex> reference =
        history.relation.tie().asking_node;
    if (!history.all_grow || !reference) return false;
    if (*reference == query_.node) return true;
    // Most histories have the same.
    if (reference != grown_since_) {
      grown_since_ = reference;
      has_grown_ = NoiseIsAdded(model_.similarity.state_space, query_.graph,
                                std::min(*reference, query_.node),
                                std::max(*reference, query_.node));
    }
    return has_grown_;
  }

  bool IsFar(const History& history, const FrameWay& way, double scale,
             double log_weight) const {
    const Relation& relation = history.relation;
    const FramePair<D> pair(relation.frames(), relation.tie(), query_.node,
                            model_.similarity.inflation * scale,
                            way.fixed_scale);
    const std::size_t parts =
        std::max<std::size_t>(1, model_.scales.size()) * relation.ways().size();
    const double log_odds = *most_log_odds_ + way.log_weight + log_weight +
                            std::log(static_cast<double>(parts)) + kAside -
                            model_.least_log_share;
    const double apart = ApartMeters(history);
    const bool has_before = pair.reference() > history.first;
    for (const bool is_before : {true, false}) {
      if (is_before && !has_before) continue;
      const BlockBounds::Region region =
          RegionOf(pair, is_before, log_odds, apart);
      for (const NodeExtent& extent : *history.extents) {
        if (BlockBounds::Near(region, extent.bounds) ||
            !IsConditioned(pair, is_before, apart, extent)) {
          return false;
        }
      }
    }
    return true;
  }

  // How far the ends around a sample may lie, which stands for all of them.
  double ApartMeters(const History& history) const {
    return static_cast<double>(StrideOf(history.size())) *
           model_.spacing_meters;
  }

  BlockBounds::Region RegionOf(const FramePair<D>& pair, bool is_before,
                               double log_odds, double apart) const {
    const StateMatrix<D> own =
        pair.own() +
        Swung<D>(pair.swung(is_before), pair.place(), pair.query());
    const auto most = [](const StateMatrix<D>& m) {
      return VariancesInAnyDirection(m(0, 0), m(0, 1), m(1, 1)).most;
    };
    const double of_neither = tolerance_(0, 0) + most(shift_) + apart * apart;
    BlockBounds::Region region;
    region.x = pair.query().x;
    region.y = pair.query().y;
    region.variance =
        of_neither + std::max(0.0, most(own)) * (1.0 + kAsideShare);
    region.squared_per_variance = 2.0 * log_odds * (1.0 + kAsideShare);
    const double node_scale = pair.node_scale(is_before);
    (is_before ? region.least_taken : region.most_added) = std::abs(node_scale);
    return region;
  }

  // Whether G + B is well-conditioned at all nodes of a stretch.
  bool IsConditioned(const FramePair<D>& pair, bool is_before, double apart,
                     const NodeExtent& extent) const {
    constexpr int h = D - 1;
    const StateMatrix<D>& swung = pair.swung(is_before);
    const NodeBounds& bounds = extent.bounds;
    const double arms[] = {
        Farthest(bounds.least_y, bounds.most_y, pair.place().y),
        Farthest(bounds.least_x, bounds.most_x, pair.place().x)};
    for (int i = 0; i < D; ++i) {
      double of_node = extent.most_heading_variance;
      double added = kPi * kPi;
      if (i < 2) of_node = bounds.most_variance;
      if (i == 2 && D == 4) of_node = extent.most_z_variance;
      if (i < h) added = apart * apart;
      double most = std::abs(pair.own()(i, i)) +
                    std::abs(pair.node_scale(is_before)) * of_node +
                    std::abs(swung(i, i)) + shift_(i, i) + added +
                    tolerance_(i, i);
      if (i < 2) {
        most += arms[i] *
                (2.0 * std::abs(swung(i, h)) + arms[i] * std::abs(swung(h, h)));
      }
      // Written so that NaN is not.
      if (!(tolerance_(i, i) >= kLeastToleratedShare * most)) return false;
    }
    return true;
  }

  const Query& query_;
  const RelativeModel& model_;
  // B of one end, in the axes of the vehicle there.
  const StateMatrix<D> shift_;
  StateMatrix<D> tolerance_;
  // The log-odds of an end that nothing is known to lie away from; nothing
  // where there is no such bound.
  std::optional<double> most_log_odds_;
  double greatest_scale_ = 0.0;
  double most_log_weight_ = kImpossible;
  std::optional<NodeIndex> grown_since_;
  bool has_grown_ = false;
};

FarHistories::FarHistories(const Query& query, const RelativeModel& model,
                           AlignmentParts* path) {
  if (model.least_log_share == kImpossible) return;
  if (model.similarity.state_space == StateSpace::kPlanar) {
    test_ = std::make_unique<TestIn<3>>(query, model,
                                        *PathOf<3>(query, model, path));
  } else {
    test_ = std::make_unique<TestIn<4>>(query, model,
                                        *PathOf<4>(query, model, path));
  }
}

FarHistories::~FarHistories() = default;

bool FarHistories::Has(const History& history) {
  return test_ != nullptr && test_->IsFar(history);
}

}  // namespace revisit::core
