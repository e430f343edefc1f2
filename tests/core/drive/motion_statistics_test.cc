#include "core/drive/motion_statistics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/oracle/motion_at_once.h"
#include "tests/oracle/motion_by_loops.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

template <int D>
void ExpectStatisticsOfLoops(const PoseGraph& graph, CorrelationModel model,
                             NodeIndex last) {
  const MotionStatistics<D> actual =
      oracle::MeasureMotion<D>(graph, model, last);
  const oracle::MotionByLoops expected =
      oracle::MeasureByLoops(graph, model, last, D);
  EXPECT_EQ(actual.steps, expected.steps);
  const double unit = static_cast<double>(expected.largest_term);
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      EXPECT_NEAR(actual.drift(r, c), static_cast<double>(expected.drift(r, c)),
                  1e-12 * unit);
      EXPECT_NEAR(actual.jitter(r, c),
                  static_cast<double>(expected.jitter(r, c)), 1e-12 * unit);
    }
  }
}

TEST(MotionStatisticsTest, AgreesWithLoopsOverAllSteps) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const NodeIndex size = UniformInt(random, 1, 30);
    const PoseGraph graph = RandomGraph(random, size, 0.2, 0, true);
    const NodeIndex last = UniformInt(random, 0, static_cast<int>(size) - 1);
    for (CorrelationModel model :
         {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
          CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes}) {
      ExpectStatisticsOfLoops<3>(graph, model, last);
      ExpectStatisticsOfLoops<4>(graph, model, last);
    }
  }
}

TEST(MotionStatisticsTest, FindsTheNoiseThatTheCovariancesGrewBy) {
  // A circle, so that every heading occurs.
  const double spacing = 2.0;
  std::vector<Pose> path;
  for (int i = 0; i < 400; ++i) {
    const double angle = 0.05 * i;
    path.push_back(
        {40.0 * std::sin(angle), 40.0 - 40.0 * std::cos(angle), 0.0, angle});
  }
  const oracle::Noise noise;
  PoseGraph graph;
  for (const PoseSample& sample : oracle::WithCovariances(path, noise)) {
    Node node;
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    graph.AddNode(node, sample.sequence == 1, std::nullopt);
  }
  const auto motion =
      oracle::MeasureMotion<3>(graph, CorrelationModel::kDeadReckoning, 399);
  EXPECT_EQ(motion.steps, 399);
  // Noise is drawn in the axes of the node before, 0.05 rad away.
  EXPECT_NEAR(std::sqrt(motion.drift(0, 0) / spacing), noise.along_meters,
              0.001);
  EXPECT_NEAR(std::sqrt(motion.drift(1, 1) / spacing), noise.across_meters,
              0.001);
  EXPECT_NEAR(std::sqrt(motion.drift(2, 2) / spacing), noise.heading_radians,
              1e-5);
  EXPECT_EQ(motion.jitter, (StateMatrix<3>::Zero()));
}

TEST(MotionStatisticsTest, ErrorsThatStartAnewDoNotDrift) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 20, 0.0, 0, false);
  const auto motion =
      oracle::MeasureMotion<4>(graph, CorrelationModel::kIndependent, 19);
  EXPECT_EQ(motion.drift, (StateMatrix<4>::Zero()));
  EXPECT_GT(motion.jitter.trace(), 0.0);
}

TEST(MotionStatisticsTest, CorrelatedFixesWanderOffAndTheirHeadingsDoNot) {
  PoseGraph graph;
  for (int i = 0; i < 10; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    node.pose.x = 2.0 * i;
    node.covariance(0, 0) = 9.0;
    node.covariance(1, 1) = 4.0;
    node.covariance(3, 3) = 0.01;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const auto motion = oracle::MeasureMotion<3>(
      graph, {CorrelationModel::kCorrelatedFixes, 50.0}, 9);
  const double share = 1.0 - std::exp(-2.0 / 50.0);
  EXPECT_NEAR(motion.drift(0, 0), share * 18.0, 1e-12);
  EXPECT_NEAR(motion.drift(1, 1), share * 8.0, 1e-12);
  EXPECT_EQ(motion.drift(2, 2), 0.0);
  EXPECT_NEAR(motion.jitter(2, 2), 0.01, 1e-12);
  EXPECT_EQ(motion.jitter(0, 0), 0.0);
  EXPECT_EQ(motion.jitter(1, 1), 0.0);
}

TEST(MotionStatisticsTest, StepsOverJumpsDoNotCount) {
  PoseGraph graph;
  for (int i = 0; i < 6; ++i) {
    Node node;
    for (int k : {0, 1, 3}) node.covariance(k, k) = i < 3 ? 1.0 : 1e6;
    graph.AddNode(node, i % 3 == 0, std::nullopt);
  }
  const auto motion =
      oracle::MeasureMotion<3>(graph, CorrelationModel::kDeadReckoning, 5);
  EXPECT_EQ(motion.steps, 4);
  EXPECT_EQ(motion.drift, (StateMatrix<3>::Zero()));
}

TEST(MotionStatisticsTest, CovariancesThatShrinkLeaveNoNegativeNoise) {
  // An optimiser may make later nodes more certain than earlier ones.
  PoseGraph graph;
  for (int i = 0; i < 10; ++i) {
    Node node;
    node.covariance(0, 0) = 10.0 - i;
    node.covariance(1, 1) = 1.0 + i;
    node.covariance(3, 3) = 0.1;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const auto motion =
      oracle::MeasureMotion<3>(graph, CorrelationModel::kDeadReckoning, 9);
  EXPECT_NEAR(motion.drift(0, 0), 0.0, 1e-12);
  EXPECT_NEAR(motion.drift(1, 1), 1.0, 1e-12);
}

TEST(ShareOfStretchesTest, AgreesWithLoopsOverAllStretches) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const NodeIndex size = UniformInt(random, 1, 80);
    const PoseGraph graph = RandomGraph(random, size, 0.05, 0, false);
    const NodeIndex last = UniformInt(random, 0, static_cast<int>(size) - 1);
    const NodeIndex stretch = UniformInt(random, 1, 12);
    const double tolerance = Uniform(random, 0.01, 1.0);
    std::vector<double> turns;
    for (int k = 0; k < 20; ++k) turns.push_back(Uniform(random, -kPi, kPi));
    const std::vector<double> shares =
        oracle::ShareOfStretches(graph, last, stretch, turns, tolerance);
    ASSERT_EQ(shares.size(), turns.size());
    for (std::size_t k = 0; k < turns.size(); ++k) {
      EXPECT_NEAR(shares[k],
                  static_cast<double>(oracle::ShareByLoops(
                      graph, last, stretch, turns[k], tolerance)),
                  1e-12);
    }
  }
}

TEST(ShareOfStretchesTest, AStraightRoadIsCommonAndACornerRare) {
  // 90 nodes straight on, then a corner within one step, then as many again.
  PoseGraph graph;
  for (int i = 0; i < 180; ++i) {
    Node node;
    node.pose.heading = i < 90 ? 0.0 : 0.5 * kPi;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const std::vector<double> shares = oracle::ShareOfStretches(
      graph, 179, 5, {0.0, 0.5 * kPi, -0.5 * kPi}, 0.1);
  EXPECT_DOUBLE_EQ(shares[0], 171.0 / 176.0);
  EXPECT_DOUBLE_EQ(shares[1], 6.0 / 176.0);
  // Never seen, yet not impossible.
  EXPECT_DOUBLE_EQ(shares[2], 1.0 / 176.0);
}

}  // namespace
}  // namespace revisit::core
