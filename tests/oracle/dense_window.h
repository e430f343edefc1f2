// The joint Gaussian of a whole window of mismatches, e_1 .. e_L, as one dense
// covariance built from the generative model of shape_filter.h:
//
//   e_t = Phi(t,0) drift_0 + sum over k <= t of Phi(t,k) w_k + s_t,
//
// with Phi(t,k) the product of the lever arms of the steps after k. Filter and
// smoother are conditioning of this Gaussian, here by a Cholesky factor of all
// of it, in long double.
#ifndef REVISIT_TESTS_ORACLE_DENSE_WINDOW_H_
#define REVISIT_TESTS_ORACLE_DENSE_WINDOW_H_

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/alignment/shape_filter.h"
#include "tests/oracle/motion_by_loops.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

struct DenseWindowModel {
  int dimensions = 3;
  core::CorrelationModel correlation = core::CorrelationModel::kDeadReckoning;
  WideMatrix drift;
  WideMatrix jitter;
  core::ShapeModel shape;
  core::PlaceTolerance place_tolerance;
  double spacing_meters = 2.0;
  double inflation = 1.0;
};

class DenseWindow {
 public:
  DenseWindow(const core::PoseGraph& graph, core::NodeIndex query,
              std::int64_t steps, const DenseWindowModel& model)
      : d_(model.dimensions), length_(static_cast<int>(steps) - 1) {
    const core::Pose& end = graph.node(query).pose;
    for (std::int64_t t = 0; t < steps; ++t) {
      path_.push_back(SeenFromEnd(graph.node(query - t).pose, end));
    }
    const Wide claimed = static_cast<Wide>(model.inflation) * model.inflation;
    const Wide root = std::sqrt(static_cast<Wide>(model.spacing_meters));
    // Two passes each.
    WideMatrix step_noise =
        2.0L * claimed * model.drift +
        WideDiagonal(core::kLeastStepNoise.position_meters * root,
                     core::kLeastStepNoise.heading_radians * root, d_);
    if (model.correlation == core::CorrelationModel::kDeadReckoning) {
      for (int k = 0; k < d_; ++k) {
        const Wide most =
            root * (k + 1 < d_ ? core::kMostStepNoise.position_meters
                               : core::kMostStepNoise.heading_radians);
        const Wide deviation = std::sqrt(step_noise(k, k));
        if (deviation <= most) continue;
        step_noise.row(k) *= most / deviation;
        step_noise.col(k) *= most / deviation;
      }
    }
    const WideMatrix jitter = 2.0L * claimed * model.jitter;
    const WideMatrix tolerance =
        WideDiagonal(model.shape.tolerance.position_meters,
                     model.shape.tolerance.heading_radians, d_);
    end_prior_ =
        jitter +
        WideDiagonal(
            std::max(1e-4, std::min(model.shape.tolerance.position_meters,
                                    model.place_tolerance.position_meters)),
            std::max(1e-4, model.place_tolerance.heading_radians), d_);
    weight_ = std::min(1.0L, static_cast<Wide>(model.spacing_meters) /
                                 model.shape.correlation_meters);

    // Independent sources drift_0, w_1 .. w_L, s_1 .. s_L, and how each comes
    // to be part of the mismatches.
    const int sources = 1 + 2 * length_;
    WideMatrix mixing = WideMatrix::Zero(length_ * d_, sources * d_);
    std::vector<WideMatrix> source(static_cast<std::size_t>(sources));
    source[0] = end_prior_;
    for (int t = 1; t <= length_; ++t) {
      const WideMatrix turn = WideTurn(path(t)(d_ - 1), d_);
      source[static_cast<std::size_t>(t)] =
          turn * step_noise * turn.transpose();
      source[static_cast<std::size_t>(length_ + t)] =
          tolerance + turn * jitter * turn.transpose();
      WideMatrix phi = WideMatrix::Identity(d_, d_);
      for (int k = t; k >= 0; --k) {
        mixing.block((t - 1) * d_, k * d_, d_, d_) = phi;
        if (k == 0) break;
        const WideVector step = path(k) - path(k - 1);
        phi = (phi * WideLever(step(0), step(1), d_)).eval();
      }
      mixing.block((t - 1) * d_, (length_ + t) * d_, d_, d_).setIdentity();
    }
    WideMatrix mixed = mixing;
    for (int k = 0; k < sources; ++k) {
      mixed.middleCols(k * d_, d_) =
          mixing.middleCols(k * d_, d_) * source[static_cast<std::size_t>(k)];
    }
    covariance_ = mixed * mixing.transpose();
    // Cov(e, drift_0)
    with_end_ = mixed.leftCols(d_);

    const auto stretch = std::max<core::NodeIndex>(
        1, std::min<core::NodeIndex>(
               steps - 1, std::llround(model.shape.correlation_meters /
                                       model.spacing_meters)));
    const Wide turn_tolerance =
        std::sqrt(2.0L * (tolerance(d_ - 1, d_ - 1) + jitter(d_ - 1, d_ - 1)));
    const core::NodeIndex first = query - steps + 1;
    for (std::int64_t t = 0; t < steps; ++t) {
      // As long as a stretch and around the node, as far as the path goes.
      core::NodeIndex newest = std::min(query, query - t + stretch / 2);
      const core::NodeIndex oldest = std::max(first, newest - stretch);
      newest = std::min(query, oldest + stretch);
      const auto turn = [&graph](core::NodeIndex a, core::NodeIndex b) {
        return static_cast<double>(
            NearestTo(0.0L, static_cast<Wide>(graph.node(b).pose.heading) -
                                graph.node(a).pose.heading));
      };
      const double turned = turn(oldest, newest);
      Wide share = ShareByLoops(graph, query, stretch, turned,
                                static_cast<double>(turn_tolerance));
      if (newest + stretch <= query && !(jitter(d_ - 1, d_ - 1) > 0.0L)) {
        share = PairShareByLoops(graph, query, stretch, turned,
                                 turn(newest, newest + stretch), share);
      }
      surprise_.push_back(-std::log(share));
    }
    surprise_.back() += join_cost() / weight_;
  }

  int dimensions() const { return d_; }
  Wide weight() const { return weight_; }
  // The recent path, seen from its end.
  const WideVector& path(std::int64_t t) const {
    return path_[static_cast<std::size_t>(t)];
  }
  // -ln of the share of own stretches that turn as the path does around t, of
  // those before one that turns as the path does right after.
  Wide surprise(std::int64_t t) const {
    return surprise_[static_cast<std::size_t>(t)];
  }
  // The cost that every path is charged with, and that the surprise of the last
  // step gives back.
  Wide join_cost() const { return path_.size() > 1 ? core::kJoinCost : 0.0; }
  const WideMatrix& end_prior() const { return end_prior_; }

  // The covariance of e_1 .. e_l, stacked.
  WideMatrix Covariance(int l) const {
    return covariance_.topLeftCorner(l * d_, l * d_);
  }

  // Sum of the squared innovations of a filter: chain rule of the density.
  Wide SquaredInnovations(const WideVector& e) const {
    if (e.size() == 0) return 0.0L;
    return e.dot(Factor(Length(e)).solve(e));
  }

  // E(e_(L+1) | e_1 .. e_L)
  WideVector Predict(const WideVector& e) const {
    const int l = Length(e);
    if (l == 0) return WideVector::Zero(d_);
    return covariance_.block(l * d_, 0, d_, l * d_) * Factor(l).solve(e);
  }

  // E(drift_0 | e)
  WideVector EndMean(const WideVector& e) const {
    const int l = Length(e);
    if (l == 0) return WideVector::Zero(d_);
    return with_end_.topRows(l * d_).transpose() * Factor(l).solve(e);
  }

  // Cov(drift_0 | e_1 .. e_L)
  WideMatrix EndCovariance(int l) const {
    if (l == 0) return end_prior_;
    const WideMatrix with_end = with_end_.topRows(l * d_);
    return end_prior_ - with_end.transpose() * Factor(l).solve(with_end);
  }

  // By how much the covariance of drift_0 shrinks, if of the information that
  // the mismatches bring only the share `weight` counts.
  WideMatrix EndCertainty(int l) const {
    const WideMatrix prior = end_prior_.inverse();
    const WideMatrix gathered = EndCovariance(l).inverse() - prior;
    return end_prior_ - (prior + weight_ * gathered).inverse();
  }

 private:
  using Cholesky = Eigen::LLT<WideMatrix>;

  WideVector SeenFromEnd(const core::Pose& pose, const core::Pose& end) const {
    WideVector seen = WideTurn(-static_cast<Wide>(end.heading), d_) *
                      (WideStateOf(pose, d_) - WideStateOf(end, d_));
    seen(d_ - 1) = NearestTo(0.0L, seen(d_ - 1));
    return seen;
  }

  int Length(const WideVector& e) const {
    return static_cast<int>(e.size()) / d_;
  }

  // Made once for each length.
  const Cholesky& Factor(int l) const {
    if (factors_.empty())
      factors_.resize(static_cast<std::size_t>(length_) + 1);
    auto& factor = factors_[static_cast<std::size_t>(l)];
    if (factor.rows() == 0 && l > 0) factor.compute(Covariance(l));
    return factor;
  }

  int d_;
  int length_;
  Wide weight_ = 1.0L;
  std::vector<WideVector> path_;
  std::vector<Wide> surprise_;
  WideMatrix end_prior_;
  WideMatrix covariance_;
  WideMatrix with_end_;
  mutable std::vector<Cholesky> factors_;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_DENSE_WINDOW_H_
