#include "core/search/candidates/gate.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

TEST(GateTest, ThresholdsAreTheTablesOfChiSquare) {
  // Abramowitz & Stegun, table 26.8; the paper's own gate is 9.49.
  EXPECT_NEAR(Gate(StateSpace::kSpatial, 0.95).threshold(), 9.48773, 5e-6);
  EXPECT_NEAR(Gate(StateSpace::kPlanar, 0.95).threshold(), 7.81473, 5e-6);
  EXPECT_NEAR(Gate(StateSpace::kPlanar, 0.99).threshold(), 11.3449, 5e-5);
}

TEST(GateTest, AcceptsUpToAndIncludingTheThreshold) {
  const Gate gate(StateSpace::kPlanar, 0.95);
  EXPECT_EQ(gate.Decide(gate.threshold()).verdict, GateVerdict::kAccepted);
  EXPECT_NEAR(gate.Decide(gate.threshold()).p_value, 0.05, 1e-12);
  EXPECT_EQ(gate.Decide(std::nextafter(gate.threshold(), 100.0)).verdict,
            GateVerdict::kRejected);
  EXPECT_EQ(gate.Decide(0.0).p_value, 1.0);
}

TEST(GateTest, APathIsJudgedAtTheSameProbability) {
  const Gate gate(StateSpace::kPlanar, 0.95);
  const GateResult end_alone = gate.DecidePath(5.0, 3.0);
  const GateResult single = gate.Decide(5.0);
  EXPECT_DOUBLE_EQ(end_alone.threshold, single.threshold);
  EXPECT_DOUBLE_EQ(end_alone.p_value, single.p_value);
  EXPECT_EQ(end_alone.verdict, GateVerdict::kAccepted);
  // 3 (1 + 0.2 * 74) degrees of freedom, between 47 and 48 of the tables.
  const GateResult path = gate.DecidePath(70.0, 47.4);
  EXPECT_EQ(path.degrees_of_freedom, 47.4);
  EXPECT_GT(path.threshold, 64.00);
  EXPECT_LT(path.threshold, 65.18);
  EXPECT_EQ(path.verdict, GateVerdict::kRejected);
  EXPECT_LT(path.p_value, 0.05);
  EXPECT_EQ(gate.DecidePath(path.threshold, 47.4).verdict,
            GateVerdict::kAccepted);
}

TEST(GateTest, ExtremeArgumentsGiveNumbersAndNotExceptions) {
  EXPECT_EQ(Gate(StateSpace::kPlanar, 0.95).Decide(1e300).p_value, 0.0);
  EXPECT_GE(Gate(StateSpace::kPlanar, 5e-324).threshold(), 0.0);
  const double almost_one = std::nextafter(1.0, 0.0);
  EXPECT_GT(Gate(StateSpace::kSpatial, almost_one).threshold(), 70.0);
}

TEST(GateTest, DoesNotInventNumbersForIllConditionedDifferences) {
  PoseGraph graph;
  Node node;  // All variances zero, and no tolerance.
  graph.AddNode(node, true, std::nullopt);
  graph.AddNode(node, false, std::nullopt);
  SimilarityModel model;
  model.tolerance = {0.0, 0.0};
  const GatedDifference decided = *DecideAt(
      {graph, 1}, {graph, 1}, model, Gate(StateSpace::kPlanar, 0.95), 0, 0);
  EXPECT_EQ(decided.gate.verdict, GateVerdict::kIllConditioned);
  EXPECT_EQ(decided.gate.squared_mahalanobis, 0.0);
  EXPECT_EQ(decided.gate.p_value, 0.0);
  EXPECT_EQ(decided.gate.degrees_of_freedom, 3);
}

TEST(GateTest, AcceptsTrueRevisitsWithTheStatedProbability) {
  // A lap and a half of a rounded square, drawn many times from the model that
  // the covariances state: node `later` is truly where node `earlier` was.
  std::mt19937_64 random = SeededRandom();
  std::vector<Pose> truth;
  const int lap = 200;
  for (int i = 0; i < lap + lap / 2; ++i) {
    const double along = 2.0 * kPi * i / lap;
    const double radius = 60.0 + 10.0 * std::cos(4.0 * along);
    truth.push_back({radius * std::cos(along), radius * std::sin(along), 0.0,
                     along + 0.5 * kPi});
  }
  oracle::Noise noise;
  noise.heading_radians = 0.0005;
  const NodeIndex earlier = 40;
  const NodeIndex later = earlier + lap;
  SimilarityModel model;
  model.tolerance = {0.0, 0.0};
  const Gate gate(StateSpace::kPlanar, 0.95);
  const int draws = 4000;
  int accepted = 0;
  for (int draw = 0; draw < draws; ++draw) {
    PoseGraph graph;
    for (const PoseSample& sample : oracle::WithCovariances(
             oracle::DrawEstimate(truth, noise, random), noise)) {
      Node node;
      node.sequence = sample.sequence;
      node.pose = sample.pose;
      node.covariance = sample.covariance;
      graph.AddNode(node, sample.sequence == 1, std::nullopt);
    }
    accepted +=
        DecideAt({graph, later}, {graph, later}, model, gate, earlier, 0)
            ->gate.verdict == GateVerdict::kAccepted;
  }
  // Binomial: sigma = sqrt(0.95 * 0.05 / 4000) = 0.0034; four sigma.
  EXPECT_NEAR(static_cast<double>(accepted) / draws, 0.95, 0.014);
}

TEST(GateTest, ReportsGammaWithoutTheTolerance) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 4, 0.0, 0, false);
  SimilarityModel model;
  model.correlation = CorrelationModel::kIndependent;
  const GatedDifference decided = *DecideAt(
      {graph, 3}, {graph, 3}, model, Gate(StateSpace::kPlanar, 0.95), 1, 0);
  const StateMatrix<3> expected =
      DifferenceCovariance<3>(graph, model.correlation, 3, 1);
  EXPECT_EQ(ToMatrix<3>(decided.covariance), expected);
  EXPECT_DOUBLE_EQ(decided.difference.x,
                   graph.node(3).pose.x - graph.node(1).pose.x);
}

}  // namespace
}  // namespace revisit::core
