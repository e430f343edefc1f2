#include "core/search/alignment/shape_filter.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <sstream>
#include <vector>

#include "core/drive/motion_history.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dense_window.h"
#include "tests/oracle/motion_by_loops.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// A road that bends, with unrelated covariances at its nodes.
PoseGraph RandomRoad(std::mt19937_64& random, NodeIndex size, double spacing,
                     double covariance_scale) {
  PoseGraph graph;
  Pose pose = RandomPose(random, 1000.0);
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.travelled_meters = spacing * static_cast<double>(i);
    node.pose = pose;
    node.covariance = RandomCovariance(random, covariance_scale);
    Eigen::Matrix4d transition = 0.9 * Eigen::Matrix4d::Identity();
    for (int k = 0; k < 16; ++k) transition(k) += Normal(random, 0.02);
    graph.AddNode(node, i == 0, ToErrorTransition<4>(transition));
    pose.x += spacing * std::cos(pose.heading);
    pose.y += spacing * std::sin(pose.heading);
    pose.z += Normal(random, 0.1);
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.15));
  }
  return graph;
}

struct Window {
  PoseGraph graph;
  NodeIndex query = 0;
  std::int64_t steps = 0;
  CorrelationModel correlation = CorrelationModel::kDeadReckoning;
  ShapeModel shape;
  PlaceTolerance place;
  double spacing = 2.0;
  double inflation = 1.0;

  std::string Text() const {
    std::ostringstream text;
    text << steps << " steps of " << spacing << " m, model "
         << static_cast<int>(correlation) << ", shape tolerance "
         << shape.tolerance.position_meters << " m "
         << shape.tolerance.heading_radians << " rad, correlated over "
         << shape.correlation_meters << " m, place tolerance "
         << place.position_meters << " m " << place.heading_radians
         << " rad, inflation " << inflation;
    return text.str();
  }
};

Window RandomWindow(std::mt19937_64& random, std::int64_t steps) {
  Window window;
  window.steps = steps;
  window.spacing = std::exp(Uniform(random, std::log(0.5), std::log(10.0)));
  window.correlation = static_cast<CorrelationModel>(UniformInt(random, 0, 3));
  window.query = steps + UniformInt(random, 0, 40);
  window.graph = RandomRoad(random, window.query + UniformInt(random, 1, 5),
                            window.spacing, Uniform(random, 0.01, 2.0));
  window.shape.tolerance.position_meters =
      std::exp(Uniform(random, std::log(0.01), std::log(10.0)));
  window.shape.tolerance.heading_radians =
      std::exp(Uniform(random, std::log(0.005), std::log(0.5)));
  window.shape.correlation_meters =
      std::exp(Uniform(random, std::log(0.5), std::log(200.0)));
  window.place.position_meters =
      UniformInt(random, 0, 4) == 0 ? 0.0 : Uniform(random, 0.1, 20.0);
  window.place.heading_radians =
      UniformInt(random, 0, 4) == 0 ? 0.0 : Uniform(random, 0.01, 0.5);
  window.inflation = UniformInt(random, 0, 1) ? Uniform(random, 1.0, 3.0) : 1.0;
  return window;
}

// Draws a window's mismatches from the model, or twice as large, and compares
// the filter's results with those of the dense joint Gaussian.
template <int D>
void ExpectFilterIsTheDenseGaussian(std::mt19937_64& random,
                                    const Window& window) {
  SCOPED_TRACE(window.Text());
  const oracle::MotionByLoops motion =
      oracle::MeasureByLoops(window.graph, window.correlation, window.query, D);
  const oracle::DenseWindow dense(
      window.graph, window.query, window.steps,
      {D, window.correlation, motion.drift, motion.jitter, window.shape,
       window.place, window.spacing, window.inflation});
  MotionHistory history(D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial,
                        window.correlation,
                        StretchNodes(window.shape, window.spacing, 1000));
  history.Extend(window.graph);
  // Statistics that the history does not have are measured.
  const ShapeFilter<D> filter({window.graph, window.query, window.steps,
                               UniformInt(random, 0, 1) ? &history : nullptr},
                              window.correlation, window.shape, window.place,
                              window.spacing, window.inflation);
  ASSERT_EQ(filter.size(), window.steps);
  EXPECT_EQ(filter.EndCertainty(0), (StateMatrix<D>::Zero()));

  const int length = static_cast<int>(window.steps) - 1;
  const oracle::WideMatrix root =
      oracle::WideMatrix(dense.Covariance(length).llt().matrixL());
  oracle::WideVector e(length * D);
  for (int k = 0; k < e.size(); ++k) {
    e(k) = Normal(random, Uniform(random, 0.0, 2.0));
  }
  e = (root * e).eval();
  // No innovation exceeds half a turn, beyond which another one is nearest.
  for (int t = 1; t <= length; ++t) {
    const auto innovation =
        e(t * D - 1) - dense.Predict(e.head((t - 1) * D))(D - 1);
    if (std::abs(innovation) > 3.0) e *= 3.0 / std::abs(innovation);
  }

  typename ShapeFilter<D>::Drift drift;
  double squares = 0.0;
  double ratio = 0.0;
  oracle::Wide surprise = 0.0L;
  const int looked_at = UniformInt(random, 1, std::max(1, length));
  for (int t = 1; t <= length; ++t) {
    // The other path is off by e, and its headings by whole turns.
    oracle::WideVector other = dense.path(t) - e.segment((t - 1) * D, D);
    other(D - 1) += 2.0L * oracle::kWidePi * UniformInt(random, -2, 2);
    const auto evidence =
        filter.Advance(t, other.template cast<double>(), &drift);
    squares += evidence.squared_innovation;
    ratio += evidence.log_likelihood_ratio;
    surprise += dense.surprise(t);
    if (t != looked_at && t != length) continue;

    const oracle::WideVector so_far = e.head(t * D);
    const auto expected = static_cast<double>(dense.SquaredInnovations(so_far));
    EXPECT_NEAR(squares, expected, 1e-9 * std::max(1.0, expected)) << t;
    EXPECT_NEAR(ratio, static_cast<double>(surprise) - 0.5 * expected,
                1e-9 * std::max(1.0, expected))
        << t;
    // In units of drift_0's own standard deviations.
    const oracle::WideVector mean = dense.EndMean(so_far);
    const oracle::WideMatrix certainty = dense.EndCertainty(t);
    for (int r = 0; r < D; ++r) {
      const auto unit = static_cast<double>(std::sqrt(dense.end_prior()(r, r)));
      EXPECT_NEAR(drift.at_end(r) / unit, static_cast<double>(mean(r)) / unit,
                  1e-9 * std::max(1.0, std::sqrt(expected)))
          << t << " coordinate " << r;
      for (int c = 0; c < D; ++c) {
        const double units =
            unit * static_cast<double>(std::sqrt(dense.end_prior()(c, c)));
        EXPECT_NEAR(filter.EndCertainty(t)(r, c) / units,
                    static_cast<double>(certainty(r, c)) / units, 1e-9)
            << t << " entry " << r << "," << c;
      }
    }
  }
}

TEST(ShapeFilterTest, IsTheDenseGaussianOfTheWholeWindowInThePlane) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 40; ++trial) {
    const std::int64_t steps = trial == 0 ? 75 : UniformInt(random, 1, 40);
    ExpectFilterIsTheDenseGaussian<3>(random, RandomWindow(random, steps));
  }
}

TEST(ShapeFilterTest, IsTheDenseGaussianOfTheWholeWindowInSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 30; ++trial) {
    const std::int64_t steps = trial == 0 ? 75 : UniformInt(random, 1, 30);
    ExpectFilterIsTheDenseGaussian<4>(random, RandomWindow(random, steps));
  }
}

TEST(ShapeFilterTest,
     CountsAllInformationWhereNodesAreFartherApartThanTheyShare) {
  std::mt19937_64 random = SeededRandom();
  Window window = RandomWindow(random, 20);
  window.spacing = 2.0;
  window.shape.correlation_meters = 2.0;
  EXPECT_EQ(ShapeWeight(window.shape, window.spacing), 1.0);
  const oracle::MotionByLoops motion =
      oracle::MeasureByLoops(window.graph, window.correlation, window.query, 3);
  const oracle::DenseWindow dense(
      window.graph, window.query, window.steps,
      {3, window.correlation, motion.drift, motion.jitter, window.shape,
       window.place, window.spacing, window.inflation});
  const ShapeFilter<3> filter({window.graph, window.query, window.steps},
                              window.correlation, window.shape, window.place,
                              window.spacing, window.inflation);
  const oracle::WideMatrix shrunk = dense.end_prior() - dense.EndCovariance(19);
  for (int k = 0; k < 9; ++k) {
    EXPECT_NEAR(filter.EndCertainty(19)(k), static_cast<double>(shrunk(k)),
                1e-9 * static_cast<double>(dense.end_prior().trace()));
  }
}

TEST(ShapeFilterTest, WeightIsTheShareOfTheCorrelationDistance) {
  ShapeModel shape;
  shape.correlation_meters = 10.0;
  EXPECT_DOUBLE_EQ(ShapeWeight(shape, 2.0), 0.2);
  EXPECT_DOUBLE_EQ(ShapeWeight(shape, 10.0), 1.0);
  EXPECT_DOUBLE_EQ(ShapeWeight(shape, 50.0), 1.0);
}

TEST(ShapeFilterTest, ACornerTellsMoreThanAStraight) {
  // Two hundred metres straight, a corner, and forty metres more.
  PoseGraph graph;
  Pose pose;
  for (int i = 0; i < 120; ++i) {
    Node node;
    node.pose = pose;
    for (int k : {0, 1, 3}) node.covariance(k, k) = 1.0;
    graph.AddNode(node, i == 0, std::nullopt);
    if (i == 100) pose.heading = 0.5 * kPi;
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
  }
  const auto ratio = [&graph](NodeIndex query, std::int64_t steps) {
    const ShapeFilter<3> filter({graph, query, steps},
                                CorrelationModel::kDeadReckoning, ShapeModel{},
                                PlaceTolerance{}, 2.0, 1.0);
    const Pose& end = graph.node(query).pose;
    ShapeFilter<3>::Drift drift;
    double sum = 0.0;
    for (std::int64_t t = 1; t < steps; ++t) {
      const Pose d = Difference(graph.node(query - t).pose, end);
      const double c = std::cos(end.heading);
      const double s = std::sin(end.heading);
      sum += filter
                 .Advance(t, {c * d.x + s * d.y, c * d.y - s * d.x, d.heading},
                          &drift)
                 .log_likelihood_ratio;
    }
    EXPECT_EQ(drift.at_end, (StateVector<3>::Zero()));
    // Without what the last step has for covering all of them.
    return sum - filter.join_cost() / ShapeWeight(ShapeModel{}, 2.0);
  };
  const double straight = ratio(90, 30);
  const double corner = ratio(115, 30);
  EXPECT_GE(straight, 0.0);
  EXPECT_LT(straight, 3.0);
  EXPECT_GT(corner, 10.0);
}

}  // namespace
}  // namespace revisit::core
