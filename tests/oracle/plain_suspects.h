// The suspects among confirmed loop closures as core/drive/suspects.h defines
// them, the long way: every subset of the closures is tried, what a path adds
// is summed up step by step, and errors are carried by numeric derivatives.
#ifndef REVISIT_TESTS_ORACLE_PLAIN_SUSPECTS_H_
#define REVISIT_TESTS_ORACLE_PLAIN_SUSPECTS_H_

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/pose.h"
#include "core/noise/chi_squared.h"
#include "core/noise/similarity_model.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

class PlainSuspects {
 public:
  // P-values by the closure's number among Drive::confirmed().
  using Found = std::map<std::size_t, double>;

  // REQUIRES: one recording and one segment; poses of closures are nodes; no
  // more than 20 closures, no two of which share a query.
  explicit PlainSuspects(const core::Drive& drive)
      : graph_(drive.graph()),
        d_(drive.settings().state_space == core::StateSpace::kPlanar ? 3 : 4),
        scale_(
            std::pow(drive.SimilarityOf(drive.settings().search).inflation, 2)),
        closures_(drive.confirmed()) {
    const std::size_t n = closures_.size();
    contradict_.assign(n, std::vector<bool>(n, false));
    for (std::size_t i = 0; i < n; ++i) {
      for (std::size_t j = 0; j < n; ++j) {
        if (i == j || !ComesBefore(i, j)) continue;
        const bool contradict =
            Squared(MeasuredOf(j), Carried(MeasuredOf(i), i, j)) >
            core::ChiSquaredQuantile(d_, 0.99);
        contradict_[i][j] = contradict_[j][i] = contradict;
      }
    }
  }

  // One answer for each set without a contradiction than which none is larger.
  std::vector<Found> All() const {
    const std::size_t n = closures_.size();
    std::vector<Found> answers;
    int largest = 0;
    for (std::uint32_t set = 0; set < std::uint32_t{1} << n; ++set) {
      const int size = __builtin_popcount(set);
      if (size < largest || !IsConsistent(set)) continue;
      if (size > largest) answers.clear();
      largest = size;
      answers.push_back(FoundGiven(set));
    }
    return answers;
  }

 private:
  struct Estimate {
    core::Pose relative;
    WideMatrix covariance;
  };

  bool IsConsistent(std::uint32_t set) const {
    for (std::size_t i = 0; i < closures_.size(); ++i) {
      for (std::size_t j = 0; j < i; ++j) {
        if ((set >> i & 1) && (set >> j & 1) && contradict_[i][j]) return false;
      }
    }
    return true;
  }

  core::NodeIndex Query(std::size_t i) const { return closures_[i].loop.query; }
  core::NodeIndex Matched(std::size_t i) const {
    return closures_[i].loop.matched;
  }
  bool ComesBefore(std::size_t i, std::size_t j) const {
    return Query(i) < Query(j);
  }

  Estimate MeasuredOf(std::size_t i) const {
    const core::ConfirmedLoop& loop = closures_[i].loop;
    if (loop.measured != nullptr) {
      return {loop.measured->measurement.relative,
              WideCovarianceOf(loop.measured->measurement.covariance, d_)};
    }
    Estimate estimate{{}, WideDiagonal(5.0, 0.15, d_)};
    if (std::abs(NearestTo(0.0L, graph_.pose(loop.query).heading -
                                     graph_.pose(loop.matched).heading)) >
        0.5L * kWidePi) {
      estimate.relative.heading = static_cast<double>(kWidePi);
    }
    return estimate;
  }

  // The covariance of the error of node b as seen from node a, in fixed axes:
  // the noise of each step between the two, swung to b.
  WideMatrix Between(core::NodeIndex a, core::NodeIndex b) const {
    WideMatrix sum = WideMatrix::Zero(d_, d_);
    const core::Pose to = graph_.pose(b);
    for (core::NodeIndex i = std::min(a, b) + 1; i <= std::max(a, b); ++i) {
      const core::Pose p = graph_.pose(i - 1);
      const core::Pose q = graph_.pose(i);
      const WideMatrix step = WideLever(q.x - p.x, q.y - p.y, d_);
      const WideMatrix noise =
          static_cast<Wide>(scale_) *
          (WideCovarianceOf(graph_.covariance(i), d_) -
           step * WideCovarianceOf(graph_.covariance(i - 1), d_) *
               step.transpose());
      const WideMatrix swing = WideLever(to.x - q.x, to.y - q.y, d_);
      sum += swing * noise * swing.transpose();
    }
    return sum;
  }

  // The derivative of a relative pose by an error of a pose.
  WideMatrix Derivative(
      const core::Pose& at,
      const std::function<core::Pose(const core::Pose&)>& relative) const {
    WideMatrix derivative(d_, d_);
    for (int k = 0; k < d_; ++k) {
      WideVector ends[2];
      for (const int side : {0, 1}) {
        core::Pose moved = at;
        double* const values[] = {&moved.x, &moved.y, &moved.z, &moved.heading};
        *values[Coordinate(k, d_)] += side == 0 ? -1e-5 : 1e-5;
        ends[side] = WideStateOf(relative(moved), d_);
      }
      WideVector apart = ends[1] - ends[0];
      apart(d_ - 1) = NearestTo(0.0L, apart(d_ - 1));
      derivative.col(k) = apart / 2e-5L;
    }
    return derivative;
  }

  // What an estimate for closure i says of closure j.
  Estimate Carried(const Estimate& estimate, std::size_t i,
                   std::size_t j) const {
    const core::Pose mi = graph_.pose(Matched(i));
    const core::Pose mj = graph_.pose(Matched(j));
    const core::Pose ci = graph_.pose(Query(i));
    const core::Pose cj = graph_.pose(Query(j));
    const auto chain = [&](const core::Pose& m, const core::Pose& z,
                           const core::Pose& c) {
      return core::Compose(
          core::Compose(core::Inverse(mj), m),
          core::Compose(z, core::Compose(core::Inverse(ci), c)));
    };
    const WideMatrix by_m = Derivative(mi, [&](const core::Pose& m) {
      return chain(m, estimate.relative, cj);
    });
    const WideMatrix by_z =
        Derivative(estimate.relative,
                   [&](const core::Pose& z) { return chain(mi, z, cj); });
    const WideMatrix by_c = Derivative(cj, [&](const core::Pose& c) {
      return chain(mi, estimate.relative, c);
    });
    const WideMatrix of_m = Between(Matched(j), Matched(i));
    const WideMatrix of_c = Between(Query(i), Query(j));
    Estimate carried{chain(mi, estimate.relative, cj),
                     by_m * of_m * by_m.transpose() +
                         by_z * estimate.covariance * by_z.transpose() +
                         by_c * of_c * by_c.transpose()};
    // E[(1/2 turn^2 meters)^2] of a normal turn, which is 3/4 of the variance
    // times the distance, squared.
    const auto meters = [](const core::Pose& a, const core::Pose& b) {
      return std::hypot(a.x - b.x, a.y - b.y);
    };
    const core::Pose ci_by_i =
        core::Compose(core::Compose(core::Inverse(mj), mi), estimate.relative);
    const core::Pose mi_by_j = core::Compose(core::Inverse(mj), mi);
    const Wide at_m = of_m(d_ - 1, d_ - 1) *
                      (meters(mi, mj) + meters(mi_by_j, carried.relative));
    const Wide at_c =
        (estimate.covariance(d_ - 1, d_ - 1) + of_c(d_ - 1, d_ - 1)) *
        meters(ci_by_i, carried.relative);
    for (const int k : {0, 1}) {
      carried.covariance(k, k) += 0.75L * (at_m * at_m + at_c * at_c);
    }
    return carried;
  }

  WideVector Apart(const Estimate& a, const Estimate& b) const {
    WideVector apart =
        WideStateOf(a.relative, d_) - WideStateOf(b.relative, d_);
    apart(d_ - 1) = NearestTo(0.0L, apart(d_ - 1));
    return apart;
  }
  double Squared(const Estimate& a, const Estimate& b) const {
    const WideVector apart = Apart(a, b);
    const WideMatrix sum = a.covariance + b.covariance;
    return static_cast<double>(apart.dot(sum.inverse() * apart));
  }

  Estimate Fused(const Estimate& a, const Estimate& b) const {
    const WideMatrix ia = a.covariance.inverse();
    const WideMatrix ib = b.covariance.inverse();
    Estimate fused{a.relative, WideMatrix(ia + ib).inverse()};
    const WideVector step = fused.covariance * ib * Apart(b, a);
    fused.relative.x += static_cast<double>(step(0));
    fused.relative.y += static_cast<double>(step(1));
    if (d_ == 4) fused.relative.z += static_cast<double>(step(2));
    fused.relative.heading += static_cast<double>(step(d_ - 1));
    return fused;
  }

  Found FoundGiven(std::uint32_t set) const {
    Found found;
    for (std::size_t i = 0; i < closures_.size(); ++i) {
      if (set >> i & 1) continue;
      std::vector<Estimate> sides;
      std::vector<std::size_t> last;
      for (const bool behind : {false, true}) {
        std::vector<std::size_t> given = Given(i, set, behind);
        if (given.empty()) continue;
        Estimate estimate = MeasuredOf(given[0]);
        for (std::size_t k = 1; k < given.size(); ++k) {
          estimate = Fused(MeasuredOf(given[k]),
                           Carried(estimate, given[k - 1], given[k]));
        }
        sides.push_back(Carried(estimate, given.back(), i));
        last.push_back(given.back());
      }
      if (sides.empty()) continue;
      if (sides.size() == 2) {
        const bool between =
            std::min(Matched(last[0]), Matched(last[1])) <= Matched(i) &&
            Matched(i) <= std::max(Matched(last[0]), Matched(last[1]));
        if (between) {
          sides[0] = Fused(sides[0], sides[1]);
        } else if (Way(i, last[1]) < Way(i, last[0])) {
          sides[0] = sides[1];
        }
      }
      const double p_value =
          core::ChiSquaredAbove(d_, Squared(MeasuredOf(i), sides[0]));
      double most = 0.01;
      int supporters = 0;
      for (std::size_t j = 0; j < closures_.size() && supporters < 4; ++j) {
        if (j == i || (set >> j & 1) || contradict_[i][j] || Way(i, j) > 500.0)
          continue;
        most *= 0.01;
        ++supporters;
      }
      if (p_value < most) found[i] = p_value;
    }
    return found;
  }

  double Way(std::size_t i, std::size_t j) const {
    return graph_.MetersApart(Query(i), Query(j)) +
           graph_.MetersApart(Matched(i), Matched(j));
  }

  // The nearest eight of a set on one side, the farthest query first.
  std::vector<std::size_t> Given(std::size_t i, std::uint32_t set,
                                 bool behind) const {
    std::vector<std::size_t> given;
    for (std::size_t j = 0; j < closures_.size(); ++j) {
      if ((set >> j & 1) && (behind ? ComesBefore(i, j) : ComesBefore(j, i))) {
        given.push_back(j);
      }
    }
    std::sort(given.begin(), given.end(), [&](std::size_t a, std::size_t b) {
      return Way(i, a) < Way(i, b);
    });
    given.resize(std::min<std::size_t>(given.size(), 8));
    std::sort(given.begin(), given.end(), [&](std::size_t a, std::size_t b) {
      return graph_.MetersApart(Query(i), Query(a)) >
             graph_.MetersApart(Query(i), Query(b));
    });
    return given;
  }

  const core::PoseGraph& graph_;
  int d_;
  double scale_;
  std::vector<core::ConfirmedPair> closures_;
  std::vector<std::vector<bool>> contradict_;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_PLAIN_SUSPECTS_H_
