#include "core/search/alignment/shape_filter.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/drive/motion_history.h"
#include "core/drive/motion_statistics.h"
#include "core/drive/turn_pairs.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

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

// Adds the noise of the steps of two passes, from node to node.
template <int D>
void AddStepNoise(const PlaceTolerance& per_root_meter, double spacing_meters,
                  StateMatrix<D>* noise) {
  const double root = std::sqrt(spacing_meters);
  AddTolerance<D>({per_root_meter.position_meters * root,
                   per_root_meter.heading_radians * root},
                  noise);
}

// The noise with the standard deviations that are larger reduced to these.
template <int D>
StateMatrix<D> AtMost(const PlaceTolerance& per_root_meter,
                      double spacing_meters, const StateMatrix<D>& noise) {
  StateMatrix<D> most = StateMatrix<D>::Zero();
  AddStepNoise<D>(per_root_meter, spacing_meters, &most);
  const StateVector<D> kept = (most.diagonal().cwiseQuotient(noise.diagonal()))
                                  .cwiseMin(1.0)
                                  .cwiseSqrt();
  return kept.asDiagonal() * noise * kept.asDiagonal();
}

// Nodes [first, last] of a stretch.
struct Stretch {
  NodeIndex first = 0;
  NodeIndex last = 0;
};

double Turn(const PoseGraph& graph, const Stretch& stretch) {
  return Difference(graph.pose(stretch.last), graph.pose(stretch.first))
      .heading;
}

// The stretch around each node of the path, from the end backward: of
// `stretch_nodes` steps, and centred where the path allows.
std::vector<Stretch> Stretches(NodeIndex query, std::int64_t steps,
                               NodeIndex stretch_nodes) {
  const NodeIndex first = query - steps + 1;
  std::vector<Stretch> stretches;
  for (std::int64_t t = 0; t < steps; ++t) {
    const NodeIndex start = std::max(
        first, std::min(query, query - t + stretch_nodes / 2) - stretch_nodes);
    stretches.push_back({start, std::min(query, start + stretch_nodes)});
  }
  return stretches;
}

// The motion of the query's own graph.
DrivenMotion OwnMotion(const Query& query) {
  return {query.graph, query.motion_history, query.node};
}

// Whether the pools of others hold stretches of so many nodes.
bool ArePooled(const MotionOfOthers& others, NodeIndex stretch_nodes) {
  return std::all_of(others.pooled.begin(), others.pooled.end(),
                     [&](const MotionOfOthers::Pooled& pooled) {
                       return pooled.pool.stretch_nodes() == stretch_nodes;
                     });
}

// Adds the turns of a query's own motion and of all others that count for it:
// calls add(pool) for pools, and add(motion, times) for drives.
template <typename Add>
void AddTurns(const Query& query, NodeIndex stretch_nodes, const Add& add) {
  add(OwnMotion(query), 1);
  if (query.others == nullptr) return;
  const MotionOfOthers& others = *query.others;
  if (!ArePooled(others, stretch_nodes)) {
    for (const DrivenMotion& motion : others.drives) add(motion, 1);
    return;
  }
  for (const MotionOfOthers::Pooled& pooled : others.pooled) {
    add(pooled.pool);
    for (const DrivenMotion& motion : pooled.without) add(motion, -1);
  }
  for (const DrivenMotion& motion : others.alone) add(motion, 1);
}

template <int D>
MotionSums<D> SumsOf(const DrivenMotion& motion,
                     const Correlation& correlation) {
  if (motion.history != nullptr &&
      motion.history->correlation() == correlation) {
    return motion.history->Sums<D>(motion.graph, motion.last);
  }
  MotionSums<D> sums;
  AddMotion<D>(motion.graph, correlation, 0, motion.last + 1, &sums);
  return sums;
}

template <int D>
MotionStatistics<D> MeasureAll(const Query& query,
                               const Correlation& correlation) {
  MotionSums<D> sums = SumsOf<D>(OwnMotion(query), correlation);
  if (query.others != nullptr) {
    for (const DrivenMotion& other : query.others->drives) {
      const MotionSums<D> more = SumsOf<D>(other, correlation);
      sums.steps += more.steps;
      sums.sum += more.sum;
    }
  }
  return MeanMotion<D>(correlation, sums);
}

// Lets a counter count the stretches of a drive, or those of a pool.
struct CountStretches {
  void operator()(const MotionPool& pool) const {
    counter.AddSorted(pool.turns());
  }
  void operator()(const DrivenMotion& motion, int times) const {
    if (motion.history != nullptr &&
        motion.history->stretch_nodes() == stretch_nodes) {
      motion.history->Count(motion.graph, motion.last, &counter, times);
    } else {
      VisitStretches(motion.graph, stretch_nodes, 0, motion.last + 1,
                     [&](double turn) { counter.Add(turn, times); });
    }
  }

  NodeIndex stretch_nodes;
  StretchCounter& counter;
};

// The shares of all stretches that turn so.
std::vector<double> SharesOf(const Query& query, NodeIndex stretch_nodes,
                             const std::vector<double>& turns,
                             double tolerance_radians) {
  StretchCounter counter(turns, tolerance_radians);
  AddTurns(query, stretch_nodes, CountStretches{stretch_nodes, counter});
  return counter.Shares();
}

// The bins of a graph's stretches, made anew where its index has others.
class BinsOf {
 public:
  BinsOf(const DrivenMotion& motion, NodeIndex stretch_nodes)
      : made_(stretch_nodes) {
    const MotionHistory* const history = motion.history;
    if (history != nullptr && history->stretch_nodes() == stretch_nodes &&
        history->turn_bins().size() > motion.last) {
      kept_ = &history->turn_bins();
    } else {
      made_.Extend(motion.graph);
    }
  }

  const TurnBins& operator*() const { return kept_ ? *kept_ : made_; }

 private:
  const TurnBins* kept_ = nullptr;
  TurnBins made_;
};

// Adds the pairs of a drive, or of a pool.
struct AddPairs {
  void operator()(const MotionPool& pool) const { pairs.Add(pool.pairs()); }
  void operator()(const DrivenMotion& motion, int times) const {
    pairs.Add(*BinsOf(motion, stretch_nodes), motion.last, times);
  }

  NodeIndex stretch_nodes;
  TurnPairs& pairs;
};

TurnPairs PairsOf(const Query& query, NodeIndex stretch_nodes) {
  TurnPairs pairs;
  AddTurns(query, stretch_nodes, AddPairs{stretch_nodes, pairs});
  return pairs;
}

// For each step, -ln of the probability that another road turns as the path
// does around it, given how that road turns right after; where headings jitter,
// not given that, since bins are too narrow for such turns.
std::vector<double> Surprises(const Query& query, NodeIndex stretch_nodes,
                              double tolerance_radians, bool jitter) {
  const std::vector<Stretch> stretches =
      Stretches(query.node, query.steps, stretch_nodes);
  std::vector<double> turns;
  turns.reserve(stretches.size());
  for (const Stretch& stretch : stretches) {
    turns.push_back(Turn(query.graph, stretch));
  }
  std::vector<double> shares =
      SharesOf(query, stretch_nodes, turns, tolerance_radians);
  if (!jitter) {
    const TurnPairs pairs = PairsOf(query, stretch_nodes);
    for (std::size_t t = 0; t < shares.size(); ++t) {
      const Stretch after{stretches[t].last, stretches[t].last + stretch_nodes};
      if (after.last > query.node) continue;
      shares[t] = pairs.Share(turns[t], Turn(query.graph, after), shares[t]);
    }
  }
  for (double& share : shares) share = -std::log(share);
  return shares;
}

}  // namespace

double ShapeWeight(const ShapeModel& model, double spacing_meters) {
  return std::min(1.0, spacing_meters / model.correlation_meters);
}

template <int D>
ShapeFilter<D>::ShapeFilter(const Query& query, const Correlation& correlation,
                            const ShapeModel& model,
                            const PlaceTolerance& place_tolerance,
                            double spacing_meters, double inflation) {
  const PoseGraph& graph = query.graph;
  const std::int64_t steps = query.steps;
  assert(1 <= steps && steps <= query.node + 1);
  const MotionStatistics<D> motion = MeasureAll<D>(query, correlation);
  // Both passes drift: twice the noise of one.
  const double claimed = 2.0 * inflation * inflation;
  StateMatrix<D> noise = claimed * motion.drift;
  const StateMatrix<D> jitter = claimed * motion.jitter;
  AddStepNoise<D>(kLeastStepNoise, spacing_meters, &noise);
  if (correlation.noise().has_margin_per_step) {
    noise = AtMost<D>(kMostStepNoise, spacing_meters, noise);
  }
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
  AddTolerance<D>(model.tolerance, &tolerance);

  const double weight = ShapeWeight(model, spacing_meters);
  const std::vector<double> surprises = Surprises(
      query, StretchNodes(model, spacing_meters, steps),
      std::sqrt(2.0 * (tolerance(D - 1, D - 1) + jitter(D - 1, D - 1))),
      jitter(D - 1, D - 1) > 0.0);

  StateMatrix<D> end_prior = jitter;
  AddTolerance<D>(
      {std::max(kLeastEndDrift, std::min(model.tolerance.position_meters,
                                         place_tolerance.position_meters)),
       std::max(kLeastEndDrift, place_tolerance.heading_radians)},
      &end_prior);
  const StateMatrix<D> end_prior_information = Inverse<D>(end_prior);
  constexpr int h = D - 1;
  headings_ = {end_prior(h, h), noise(h, h), tolerance(h, h) + jitter(h, h)};

  const Pose end = graph.pose(query.node);
  const StateMatrix<D> from_end = TurnAbout<D>(-end.heading);
  Errors errors{end_prior, end_prior, end_prior};
  steps_.resize(static_cast<std::size_t>(steps));
  steps_[0].path.setZero();
  steps_[0].end_certainty.setZero();
  steps_[0].end = end_prior;
  for (std::int64_t t = 1; t < steps; ++t) {
    Step& step = steps_[static_cast<std::size_t>(t)];
    step.path =
        from_end * ToVector<D>(Difference(graph.pose(query.node - t), end));
    const StateVector<D>& after = steps_[static_cast<std::size_t>(t - 1)].path;
    step.step_x = step.path(0) - after(0);
    step.step_y = step.path(1) - after(1);
    errors.Advance(noise, tolerance, jitter, &step);
    step.end = errors.end;
    const StateMatrix<D> gathered =
        Inverse<D>(errors.end) - end_prior_information;
    step.end_certainty =
        end_prior - Inverse<D>(end_prior_information + weight * gathered);
    step.surprise = surprises[static_cast<std::size_t>(t)];
  }
  steps_.back().surprise += join_cost() / weight;
  // Cov(at_end) is the sum of K S K^T over the steps, which bounds sum K nu by
  // Cauchy and Schwarz.
  end_shift_ = end_prior - errors.end;
}

template <int D>
void ShapeFilter<D>::Errors::Advance(const StateMatrix<D>& noise,
                                     const StateMatrix<D>& tolerance,
                                     const StateMatrix<D>& jitter, Step* step) {
  constexpr int h = D - 1;
  const double cosine = std::cos(step->path(h));
  const double sine = std::sin(step->path(h));
  const StateMatrix<D> predicted =
      Symmetric<D>(Swung<D>(now, -step->step_y, step->step_x) +
                   Turned<D>(noise, cosine, sine));
  cross.col(0) -= step->step_y * cross.col(h);
  cross.col(1) += step->step_x * cross.col(h);
  const StateMatrix<D> straying = tolerance + Turned<D>(jitter, cosine, sine);
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
