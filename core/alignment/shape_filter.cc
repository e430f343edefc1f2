#include "core/alignment/shape_filter.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>

namespace revisit::core {
namespace {

template <int D>
StateMatrix<D> Turn(double heading) {
  StateMatrix<D> turn = StateMatrix<D>::Identity();
  const double c = std::cos(heading);
  const double s = std::sin(heading);
  turn(0, 0) = c;
  turn(0, 1) = -s;
  turn(1, 0) = s;
  turn(1, 1) = c;
  return turn;
}

template <int D>
double LogDeterminant(const Eigen::LLT<StateMatrix<D>>& factor) {
  double sum = 0.0;
  for (int i = 0; i < D; ++i) sum += std::log(factor.matrixLLT()(i, i));
  return 2.0 * sum;
}

}  // namespace

template <int D>
ShapeFilter<D>::ShapeFilter(const PoseGraph& graph, NodeIndex query,
                            std::int64_t steps,
                            const MotionStatistics<D>& motion,
                            const ShapeModel& model, double spacing_meters,
                            double inflation) {
  assert(1 <= steps && steps <= query + 1);
  const double claimed = inflation * inflation;
  // Both passes drift.
  StateMatrix<D> noise = 2.0 * claimed * motion.drift;
  AddTolerance<D>({kLeastStepNoiseMeters * std::sqrt(spacing_meters),
                   kLeastStepNoiseRadians * std::sqrt(spacing_meters)},
                  &noise);
  StateMatrix<D> bends = StateMatrix<D>::Zero();
  bends(D - 1, D - 1) = 2.0 * motion.squared_turn;
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(model.tolerance, &tolerance);
  const StateMatrix<D> jitter = 2.0 * claimed * motion.jitter;

  const Pose& end = graph.node(query).pose;
  const StateMatrix<D> from_end = Turn<D>(-end.heading);
  StateMatrix<D> same_road = tolerance + jitter;
  StateMatrix<D> other_road = same_road;
  steps_.resize(static_cast<std::size_t>(steps));
  for (std::int64_t t = 0; t < steps; ++t) {
    Step& step = steps_[static_cast<std::size_t>(t)];
    step.path =
        from_end * ToVector<D>(Difference(graph.node(query - t).pose, end));
    if (t == 0) continue;
    const StateVector<D>& after = steps_[static_cast<std::size_t>(t - 1)].path;
    step.step_x = step.path(0) - after(0);
    step.step_y = step.path(1) - after(1);
    StateMatrix<D> f = StateMatrix<D>::Identity();
    f(0, D - 1) = -step.step_y;
    f(1, D - 1) = step.step_x;
    const StateMatrix<D> turn = Turn<D>(step.path(D - 1));
    const StateMatrix<D> straying =
        tolerance + turn * jitter * turn.transpose();
    const auto advance = [&](const StateMatrix<D>& step_noise,
                             StateMatrix<D>* covariance,
                             Hypothesis* hypothesis) {
      StateMatrix<D> predicted = f * *covariance * f.transpose() +
                                 turn * step_noise * turn.transpose();
      predicted = (0.5 * (predicted + predicted.transpose())).eval();
      const StateMatrix<D> innovation = predicted + straying;
      // Positive definite: the tolerance is not zero.
      const Eigen::LLT<StateMatrix<D>> factor(innovation);
      hypothesis->information =
          factor.solve(StateMatrix<D>::Identity());
      hypothesis->gain = predicted * hypothesis->information;
      // Joseph's form, which rounding cannot make indefinite.
      const StateMatrix<D> kept =
          StateMatrix<D>::Identity() - hypothesis->gain;
      *covariance =
          kept * predicted * kept.transpose() +
          hypothesis->gain * straying * hypothesis->gain.transpose();
      return LogDeterminant<D>(factor);
    };
    const double same = advance(noise, &same_road, &step.same_road);
    const double another =
        advance(noise + bends, &other_road, &step.other_road);
    step.log_determinants = 0.5 * (another - same);
  }
}

template class ShapeFilter<3>;
template class ShapeFilter<4>;

}  // namespace revisit::core
