#include "core/alignment/known_drift.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/geometry/heading.h"
#include "tests/core/graphs.h"
#include "tests/oracle/error_chain.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

struct Drive {
  std::vector<Pose> path;
  PoseGraph graph;
};

// A drive by dead reckoning, with the covariances of its chain of errors.
template <int D>
std::pair<Drive, oracle::ErrorChain> RandomDrive(std::mt19937_64& random,
                                                 int nodes) {
  Drive drive;
  Pose pose = RandomPose(random, 50.0);
  for (int i = 0; i < nodes; ++i) {
    drive.path.push_back(pose);
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.3));
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
    pose.z += Normal(random, 0.1);
  }
  const auto draw = [&random](double scale) {
    return oracle::WideMatrix(ToMatrix<D>(RandomCovariance(random, scale))
                                  .template cast<oracle::Wide>());
  };
  const oracle::ErrorChain chain(drive.path, draw(1.0),
                                 [&draw](std::size_t) { return draw(0.2); });
  for (int i = 0; i < nodes; ++i) {
    Node node;
    node.pose = drive.path[static_cast<std::size_t>(i)];
    const StateMatrix<D> s = chain.Cross(i, i).cast<double>();
    node.covariance = ToCovariance<D>(s);
    drive.graph.AddNode(node, i == 0, std::nullopt);
  }
  return {drive, chain};
}

template <int D>
void ExpectConditionedChain(std::mt19937_64& random) {
  const int nodes = UniformInt(random, 4, 40);
  auto [drive, chain] = RandomDrive<D>(random, nodes);
  const auto any = [&, count = nodes] {
    return static_cast<NodeIndex>(UniformInt(random, 0, count - 1));
  };
  const NodeIndex q = UniformInt(random, nodes / 2, nodes - 1);
  const NodeIndex j = any();
  const NodeIndex c = any();
  const NodeIndex m = any();
  if (q == j || c == m || c > q || m > q) return;
  SCOPED_TRACE(::testing::Message() << "q " << q << " j " << j << " c " << c
                                    << " m " << m << " of " << nodes);
  SimilarityModel model;
  model.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  model.inflation = UniformInt(random, 0, 1) ? Uniform(random, 1.0, 3.0) : 1.0;

  oracle::WideVector y = oracle::WideStateOf(drive.graph.node(c).pose, D) -
                         oracle::WideStateOf(drive.graph.node(m).pose, D);
  y(D - 1) = oracle::NearestTo(0.0L, y(D - 1));
  // Driven the other way, the headings should differ by half a turn.
  if (std::abs(y(D - 1)) > 0.5L * oracle::kWidePi) {
    y(D - 1) = oracle::NearestTo(0.0L, y(D - 1) + oracle::kWidePi);
  }
  const auto [mean, covariance] = chain.Condition(
      q, j, c, m, y, oracle::WideDiagonal(5.0, 0.15, D), model.inflation);

  // Applied to a difference of zero and to Gamma itself.
  const oracle::WideMatrix gamma = static_cast<oracle::Wide>(model.inflation) *
                                   model.inflation *
                                   (chain.Cross(q, q) + chain.Cross(j, j) -
                                    chain.Cross(q, j) - chain.Cross(j, q));
  StateVector<D> difference = StateVector<D>::Zero();
  StateMatrix<D> known = gamma.cast<double>();
  const auto known_drift = KnownDrift<D>::Make(drive.graph, model, {c, m}, q);
  ASSERT_TRUE(known_drift);
  known_drift->Apply(j, &difference, &known);
  for (int r = 0; r < D; ++r) {
    oracle::Wide expected = -mean(r);
    if (r == D - 1) expected = oracle::NearestTo(0.0L, expected);
    EXPECT_NEAR(difference(r), static_cast<double>(expected),
                1e-9 * std::max(1.0, static_cast<double>(mean.norm())));
    for (int k = 0; k < D; ++k) {
      const double unit =
          std::sqrt(static_cast<double>(gamma(r, r) * gamma(k, k)));
      EXPECT_NEAR(known(r, k) / unit,
                  static_cast<double>(covariance(r, k)) / unit, 1e-9);
    }
  }
}

TEST(KnownDriftTest, ConditionsTheJointErrorOfTheChainInThePlane) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) ExpectConditionedChain<3>(random);
}

TEST(KnownDriftTest, ConditionsTheJointErrorOfTheChainInSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) ExpectConditionedChain<4>(random);
}

TEST(KnownDriftTest, WhatAClosureHasShownHoldsForTheNodesNextToIt) {
  // Between the laps the vehicle was lost for a while: the second is 30 m north
  // of the first. The closure of one pair shows it of the next.
  PoseGraph graph;
  for (int i = 0; i < 200; ++i) {
    const double angle = 2.0 * kPi * i / 100.0;
    Node node;
    node.pose = {50.0 * std::cos(angle),
                 50.0 * std::sin(angle) + (i < 100 ? 0.0 : 30.0), 0.0,
                 WrapHeading(angle + 0.5 * kPi)};
    for (int k : {0, 1, 2}) node.covariance(k, k) = i < 100 ? 0.01 : 400.0;
    node.covariance(3, 3) = 1e-8 * (1 + i);
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const SimilarityModel model;
  const auto known = KnownDrift<3>::Make(graph, model, {150, 50}, 155);
  ASSERT_TRUE(known);
  StateVector<3> difference =
      ToVector<3>(Difference(graph.node(155).pose, graph.node(55).pose));
  StateMatrix<3> covariance =
      DifferenceCovariance<3>(graph, model.correlation, 155, 55);
  EXPECT_NEAR(difference(1), 30.0, 1e-9);
  EXPECT_NEAR(covariance(1, 1), 400.0, 0.1);
  known->Apply(55, &difference, &covariance);
  // A variance of 400 is known up to the closure's tolerance of 5 m.
  EXPECT_NEAR(difference(1), 30.0 * 25.0 / 425.0, 0.01);
  EXPECT_NEAR(covariance(1, 1), 400.0 * 25.0 / 425.0, 0.1);
}

TEST(KnownDriftTest, SaysNothingWhereCovariancesHaveShrunk) {
  // As after an optimiser: nodes from 5 on are far more certain.
  PoseGraph graph;
  for (int i = 0; i < 12; ++i) {
    Node node;
    node.pose.x = 2.0 * i;
    for (int k : {0, 1, 3}) {
      node.covariance(k, k) = (i < 5 ? 400.0 : 0.01) * (k == 3 ? 1e-9 : 1.0);
    }
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const SimilarityModel model;
  EXPECT_TRUE(KnownDrift<3>::Make(graph, model, {8, 6}, 10));
  EXPECT_TRUE(KnownDrift<3>::Make(graph, model, {3, 1}, 4));
  EXPECT_FALSE(KnownDrift<3>::Make(graph, model, {8, 2}, 10));
  EXPECT_FALSE(KnownDrift<3>::Make(graph, model, {3, 1}, 10));
}

}  // namespace
}  // namespace revisit::core
