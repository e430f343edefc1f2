#include "core/alignment/shape_filter.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>
#include <cmath>

namespace revisit::core {
namespace {

// Least standard deviation of drift_0, whose covariance must be invertible.
constexpr double kLeastEndDrift = 1e-4;

// Inverse of a positive definite matrix, by Cholesky's factor L: L^-T L^-1.
// Written out, since Eigen solves for each column of so small a matrix in a
// call of its own, which takes most of the time that a filter takes.
template <int D>
StateMatrix<D> Inverse(const StateMatrix<D>& m) {
  // L^-1, whose diagonal holds the inverse of L's.
  double factor[D][D] = {};
  double inverse[D][D] = {};
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) {
      double left = m(r, c);
      for (int k = 0; k < c; ++k) left -= factor[r][k] * factor[c][k];
      factor[r][c] = c < r ? left * inverse[c][c] : std::sqrt(left);
      if (c == r) inverse[r][r] = 1.0 / factor[r][r];
    }
  }
  for (int c = 0; c < D; ++c) {
    for (int r = c + 1; r < D; ++r) {
      double sum = 0.0;
      for (int k = c; k < r; ++k) sum += factor[r][k] * inverse[k][c];
      inverse[r][c] = -sum * inverse[r][r];
    }
  }
  StateMatrix<D> product;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) {
      double sum = 0.0;
      for (int k = r; k < D; ++k) sum += inverse[k][r] * inverse[k][c];
      product(r, c) = product(c, r) = sum;
    }
  }
  return product;
}

template <int D>
StateMatrix<D> Symmetric(const StateMatrix<D>& m) {
  return 0.5 * (m + m.transpose());
}

// How far the path turns around each of its nodes, from the end backward: over
// `stretch_nodes` steps, which are centred where the path allows.
std::vector<double> Turns(const PoseGraph& graph, NodeIndex query,
                          std::int64_t steps, NodeIndex stretch_nodes) {
  const NodeIndex first = query - steps + 1;
  std::vector<double> turns;
  for (std::int64_t t = 0; t < steps; ++t) {
    const NodeIndex start = std::max(
        first, std::min(query, query - t + stretch_nodes / 2) - stretch_nodes);
    const NodeIndex end = std::min(query, start + stretch_nodes);
    turns.push_back(Difference(graph.pose(end), graph.pose(start)).heading);
  }
  return turns;
}

}  // namespace

double ShapeWeight(const ShapeModel& model, double spacing_meters) {
  return std::min(1.0, spacing_meters / model.correlation_meters);
}

NodeIndex StretchNodes(const ShapeModel& model, double spacing_meters,
                       std::int64_t steps) {
  return std::max<NodeIndex>(
      1, std::min<NodeIndex>(steps - 1, std::llround(model.correlation_meters /
                                                     spacing_meters)));
}

template <int D>
ShapeFilter<D>::ShapeFilter(const PoseGraph& graph,
                            const MotionHistory* history, NodeIndex query,
                            std::int64_t steps, const Correlation& correlation,
                            const ShapeModel& model,
                            const PlaceTolerance& place_tolerance,
                            double spacing_meters, double inflation) {
  assert(1 <= steps && steps <= query + 1);
  const double claimed = inflation * inflation;
  const MotionStatistics<D> motion =
      history != nullptr && history->correlation() == correlation
          ? history->Measure<D>(graph, query)
          : MeasureMotion<D>(graph, correlation, query);
  // Both passes drift: twice the noise of one.
  StateMatrix<D> noise = 2.0 * claimed * motion.drift;
  AddTolerance<D>({kLeastStepNoiseMeters * std::sqrt(spacing_meters),
                   kLeastStepNoiseRadians * std::sqrt(spacing_meters)},
                  &noise);
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(model.tolerance, &tolerance);
  const StateMatrix<D> jitter = 2.0 * claimed * motion.jitter;

  const double weight = ShapeWeight(model, spacing_meters);
  const NodeIndex stretch_nodes = StretchNodes(model, spacing_meters, steps);
  const double turn_tolerance =
      std::sqrt(2.0 * (tolerance(D - 1, D - 1) + jitter(D - 1, D - 1)));
  const std::vector<double> turns = Turns(graph, query, steps, stretch_nodes);
  const std::vector<double> shares =
      history != nullptr && history->stretch_nodes() == stretch_nodes
          ? history->Shares(graph, query, turns, turn_tolerance)
          : ShareOfStretches(graph, query, stretch_nodes, turns,
                             turn_tolerance);

  StateMatrix<D> end_prior = jitter;
  AddTolerance<D>(
      {std::max(kLeastEndDrift, std::min(model.tolerance.position_meters,
                                         place_tolerance.position_meters)),
       std::max(kLeastEndDrift, place_tolerance.heading_radians)},
      &end_prior);
  const StateMatrix<D> end_prior_information = Inverse<D>(end_prior);

  const Pose end = graph.pose(query);
  const StateMatrix<D> from_end = TurnAbout<D>(-end.heading);
  Errors errors{end_prior, end_prior, end_prior};
  steps_.resize(static_cast<std::size_t>(steps));
  steps_[0].path.setZero();
  steps_[0].end_certainty.setZero();
  for (std::int64_t t = 1; t < steps; ++t) {
    Step& step = steps_[static_cast<std::size_t>(t)];
    step.path = from_end * ToVector<D>(Difference(graph.pose(query - t), end));
    const StateVector<D>& after = steps_[static_cast<std::size_t>(t - 1)].path;
    step.step_x = step.path(0) - after(0);
    step.step_y = step.path(1) - after(1);
    errors.Advance(noise, tolerance, jitter, &step);
    const StateMatrix<D> gathered =
        Inverse<D>(errors.end) - end_prior_information;
    step.end_certainty =
        end_prior - Inverse<D>(end_prior_information + weight * gathered);
    step.surprise = -std::log(shares[static_cast<std::size_t>(t)]);
  }
  // Cov(at_end) is the sum of K S K^T over the steps, which bounds sum K nu by
  // Cauchy and Schwarz.
  end_shift_ = end_prior - errors.end;
}

template <int D>
void ShapeFilter<D>::Errors::Advance(const StateMatrix<D>& noise,
                                     const StateMatrix<D>& tolerance,
                                     const StateMatrix<D>& jitter, Step* step) {
  StateMatrix<D> f = StateMatrix<D>::Identity();
  f(0, D - 1) = -step->step_y;
  f(1, D - 1) = step->step_x;
  const StateMatrix<D> turn = TurnAbout<D>(step->path(D - 1));
  const StateMatrix<D> predicted =
      Symmetric<D>(f * now * f.transpose() + turn * noise * turn.transpose());
  cross = (cross * f.transpose()).eval();
  const StateMatrix<D> straying = tolerance + turn * jitter * turn.transpose();
  step->information = Inverse<D>(predicted + straying);
  step->gain = predicted * step->information;
  step->end_gain = cross * step->information;
  // Joseph's form, which rounding cannot make indefinite.
  const StateMatrix<D> kept = StateMatrix<D>::Identity() - step->gain;
  now = Symmetric<D>(kept * predicted * kept.transpose() +
                     step->gain * straying * step->gain.transpose());
  end = Symmetric<D>(end - step->end_gain * cross.transpose());
  cross = (cross * kept.transpose()).eval();
}

template <int D>
WalkStep ShapeFilter<D>::Kernel(std::int64_t t) const {
  const Step& step = steps_[static_cast<std::size_t>(t)];
  WalkStep kernel;
  kernel.number = static_cast<double>(t);
  kernel.step_x = step.step_x;
  kernel.step_y = step.step_y;
  kernel.surprise = step.surprise;
  for (int r = 0; r < D; ++r) {
    kernel.path[r] = step.path(r);
    // Entry 0 is the path's end and no step.
    for (int c = 0; t > 0 && c < D; ++c) {
      kernel.gain[r][c] = step.gain(r, c);
      kernel.end_gain[r][c] = step.end_gain(r, c);
    }
  }
  if (t > 0) {
    const StateMatrix<D> whitening =
        Eigen::LLT<StateMatrix<D>>(step.information).matrixU();
    for (int r = 0; r < D; ++r) {
      for (int c = r; c < D; ++c) kernel.whitening[r][c] = whitening(r, c);
    }
  }
  return kernel;
}

template class ShapeFilter<3>;
template class ShapeFilter<4>;

}  // namespace revisit::core
