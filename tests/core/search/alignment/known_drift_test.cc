#include "core/search/alignment/known_drift.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "tests/core/graphs.h"
#include "tests/oracle/error_chain.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

struct ClaimedDrive {
  std::vector<Pose> path;
  PoseGraph graph;
};

// A drive by dead reckoning, with the covariances of its chain of errors.
template <int D>
std::pair<ClaimedDrive, oracle::ErrorChain> RandomDrive(std::mt19937_64& random,
                                                        int nodes) {
  ClaimedDrive drive;
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

// Applied to a difference of zero and to Gamma itself.
template <int D>
void ExpectKnown(const oracle::WideVector& mean,
                 const oracle::WideMatrix& covariance,
                 const oracle::WideMatrix& gamma,
                 const StateVector<D>& difference,
                 const StateMatrix<D>& known) {
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
  const auto [mean, covariance] =
      chain.Condition(q, j, c, m, y, oracle::WideDiagonal(5.0, 0.15, D),
                      model.inflation, oracle::WideMatrix::Identity(D, D));

  const oracle::WideMatrix gamma = static_cast<oracle::Wide>(model.inflation) *
                                   model.inflation *
                                   (chain.Cross(q, q) + chain.Cross(j, j) -
                                    chain.Cross(q, j) - chain.Cross(j, q));
  StateVector<D> difference = StateVector<D>::Zero();
  StateMatrix<D> known = gamma.cast<double>();
  const auto known_drift =
      KnownDrift<D>::Make({drive.graph, q}, model, {c, m, nullptr});
  ASSERT_TRUE(known_drift);
  known_drift->Apply(j, &difference, &known);
  ExpectKnown<D>(mean, covariance, gamma, difference, known);
}

// A node at every third pose, closures and measurements between any poses.
template <int D>
void ExpectConditionedByMeasurement(std::mt19937_64& random) {
  const int poses = UniformInt(random, 30, 60);
  auto [drive, chain] = RandomDrive<D>(random, poses);
  PoseGraph graph;
  for (NodeIndex i = 0; i < poses; i += 3) {
    graph.AddNode(drive.graph.node(i), i == 0, std::nullopt);
  }
  const int c = UniformInt(random, 3, poses - 1);
  const int m = UniformInt(random, 0, c / 3 * 3 - 1);
  const NodeIndex query =
      UniformInt(random, c / 3, static_cast<int>(graph.size()) - 1);
  const NodeIndex j = UniformInt(random, 0, static_cast<int>(graph.size()) - 1);
  if (query == j) return;
  SCOPED_TRACE(::testing::Message()
               << "q " << 3 * query << " j " << 3 * j << " c " << c << " m "
               << m << " of " << poses);
  SimilarityModel model;
  model.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  model.inflation = UniformInt(random, 0, 1) ? Uniform(random, 1.0, 3.0) : 1.0;
  const auto measured = RandomMeasurement(random, EstimateAt(drive.graph, c),
                                          EstimateAt(drive.graph, m), 0.3);

  const oracle::WideClosure closure = oracle::WideMeasured(*measured, D);
  const auto [mean, covariance] =
      chain.Condition(3 * query, 3 * j, c, m, closure.y, closure.tolerance,
                      model.inflation, closure.lever);
  const oracle::WideMatrix gamma =
      static_cast<oracle::Wide>(model.inflation) * model.inflation *
      (chain.Cross(3 * query, 3 * query) + chain.Cross(3 * j, 3 * j) -
       chain.Cross(3 * query, 3 * j) - chain.Cross(3 * j, 3 * query));
  StateVector<D> difference = StateVector<D>::Zero();
  StateMatrix<D> known = gamma.template cast<double>();
  const auto known_drift =
      KnownDrift<D>::Make({graph, query}, model, {c / 3, m / 3, measured});
  ASSERT_TRUE(known_drift);
  known_drift->Apply(j, &difference, &known);
  ExpectKnown<D>(mean, covariance, gamma, difference, known);
}

TEST(KnownDriftTest, ConditionsTheJointErrorOfTheChainInThePlane) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) ExpectConditionedChain<3>(random);
}

TEST(KnownDriftTest, ConditionsTheJointErrorOfTheChainInSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) ExpectConditionedChain<4>(random);
}

TEST(KnownDriftTest, ConditionsOnWhatWasMeasuredBetweenPosesInThePlane) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) {
    ExpectConditionedByMeasurement<3>(random);
  }
}

TEST(KnownDriftTest, ConditionsOnWhatWasMeasuredBetweenPosesInSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    ExpectConditionedByMeasurement<4>(random);
  }
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
  const auto known =
      KnownDrift<3>::Make({graph, 155}, model, {150, 50, nullptr});
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
  EXPECT_TRUE(KnownDrift<3>::Make({graph, 10}, model, {8, 6, nullptr}));
  EXPECT_TRUE(KnownDrift<3>::Make({graph, 4}, model, {3, 1, nullptr}));
  EXPECT_FALSE(KnownDrift<3>::Make({graph, 10}, model, {8, 2, nullptr}));
  EXPECT_FALSE(KnownDrift<3>::Make({graph, 10}, model, {3, 1, nullptr}));
}

TEST(KnownDriftTest, AClosureCountsAsUnmeasuredWhereCovariancesShrinkByMore) {
  // By 4 m^2, less than the tolerance of a place and more than a measurement's.
  PoseGraph graph;
  for (int i = 0; i < 12; ++i) {
    Node node;
    node.pose.x = 2.0 * i;
    for (int k : {0, 1, 3}) {
      node.covariance(k, k) = (i < 5 ? 9.0 : 5.0) * (k == 3 ? 1e-9 : 1.0);
    }
    graph.AddNode(node, i == 0, std::nullopt);
  }
  std::mt19937_64 random = SeededRandom();
  const SimilarityModel model;
  const auto measured = RandomMeasurement(random, EstimateAt(graph, 8),
                                          EstimateAt(graph, 2), 0.2);
  const auto with = KnownDrift<3>::Make({graph, 10}, model, {8, 2, measured});
  const auto without = KnownDrift<3>::Make({graph, 10}, model, {8, 2, nullptr});
  ASSERT_TRUE(with && without);
  EXPECT_EQ(with->Terms().information[0][0],
            without->Terms().information[0][0]);
  EXPECT_EQ(with->Terms().loop_difference[0],
            without->Terms().loop_difference[0]);
}

}  // namespace
}  // namespace revisit::core
