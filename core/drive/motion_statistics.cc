#include "core/drive/motion_statistics.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>

#include "core/drive/node_noise.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/covariances.h"

namespace revisit::core {
namespace {

// R^T m R with R the turn by `heading` about z.
template <int D>
StateMatrix<D> InVehicleAxes(const StateMatrix<D>& m, double heading) {
  return Turned<D>(m, std::cos(heading), -std::sin(heading));
}

template <int D>
StateMatrix<D> WithoutNegativePart(const StateMatrix<D>& m) {
  if (!m.allFinite()) return StateMatrix<D>::Zero();
  const StateMatrix<D> symmetric = 0.5 * (m + m.transpose());
  const Eigen::SelfAdjointEigenSolver<StateMatrix<D>> solver(symmetric);
  const StateVector<D> kept = solver.eigenvalues().cwiseMax(0.0);
  return solver.eigenvectors() * kept.asDiagonal() *
         solver.eigenvectors().transpose();
}

}  // namespace

template <int D>
void AddMotion(const PoseGraph& graph, const Correlation& correlation,
               NodeIndex first, NodeIndex end, MotionSums<D>* sums) {
  assert(0 <= first && end <= graph.size());
  if (first >= end) return;
  // Segments are long, so their starts are looked up only once each.
  NodeIndex next_start =
      graph.SegmentStart(first) == first ? first : graph.SegmentEnd(first);
  for (NodeIndex i = first; i < end; ++i) {
    if (i == next_start) {
      next_start = graph.SegmentEnd(i);
      continue;
    }
    ++sums->steps;
    sums->sum += InVehicleAxes<D>(StepCovariance<D>(graph, correlation, i),
                                  graph.pose(i).heading);
  }
}

template <int D>
MotionStatistics<D> MeanMotion(const Correlation& correlation,
                               const MotionSums<D>& sums) {
  MotionStatistics<D> statistics;
  statistics.steps = sums.steps;
  if (sums.steps == 0) return statistics;
  const StateMatrix<D> mean =
      WithoutNegativePart<D>(sums.sum / static_cast<double>(sums.steps));
  static_cast<StepNoise<D>&>(statistics) =
      SplitStepCovariance<D>(correlation.model, mean);
  return statistics;
}

StretchCounter::StretchCounter(const std::vector<double>& turns,
                               double tolerance_radians)
    : turns_(turns), tolerance_radians_(tolerance_radians) {
  bounds_.reserve(2 * turns.size());
  for (const double turn : turns) {
    bounds_.push_back(turn - tolerance_radians);
    bounds_.push_back(turn + tolerance_radians);
  }
  std::sort(bounds_.begin(), bounds_.end());
  beyond_.resize(bounds_.size() + 1);
  below_.resize(bounds_.size());
}

void StretchCounter::Add(double turn, std::int64_t times) {
  beyond_[BoundsUpTo(turn)] += times;
  stretches_ += times;
}

void StretchCounter::AddSorted(const std::vector<double>& stretches,
                               std::int64_t times) {
  auto at = stretches.begin();
  for (std::size_t k = 0; k < bounds_.size(); ++k) {
    at = std::lower_bound(at, stretches.end(), bounds_[k]);
    below_[k] += times * (at - stretches.begin());
  }
  stretches_ += times * static_cast<std::int64_t>(stretches.size());
}

std::vector<double> StretchCounter::Shares() const {
  std::vector<std::int64_t> below = below_;
  std::int64_t added = 0;
  for (std::size_t k = 0; k < below.size(); ++k) {
    added += beyond_[k];
    below[k] += added;
  }
  std::vector<double> shares;
  shares.reserve(turns_.size());
  for (const double turn : turns_) {
    const std::int64_t within =
        below[BoundsUpTo(turn + tolerance_radians_) - 1] -
        below[BoundsUpTo(turn - tolerance_radians_) - 1];
    shares.push_back((1.0 + static_cast<double>(within)) /
                     (1.0 + static_cast<double>(stretches_)));
  }
  return shares;
}

std::size_t StretchCounter::BoundsUpTo(double turn) const {
  return static_cast<std::size_t>(
      std::upper_bound(bounds_.begin(), bounds_.end(), turn) - bounds_.begin());
}

template void AddMotion<3>(const PoseGraph&, const Correlation&, NodeIndex,
                           NodeIndex, MotionSums<3>*);
template void AddMotion<4>(const PoseGraph&, const Correlation&, NodeIndex,
                           NodeIndex, MotionSums<4>*);
template MotionStatistics<3> MeanMotion<3>(const Correlation&,
                                           const MotionSums<3>&);
template MotionStatistics<4> MeanMotion<4>(const Correlation&,
                                           const MotionSums<4>&);

}  // namespace revisit::core
