#include "core/drive/node_noise.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

PoseGraph OneNodePerSample(const std::vector<PoseSample>& samples) {
  PoseGraph graph;
  for (const PoseSample& sample : samples) {
    Node node;
    node.sequence = sample.sequence;
    node.travelled_meters = 2.0 * static_cast<double>(sample.sequence - 1);
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    graph.AddNode(node, sample.sequence == 1, sample.transition);
  }
  return graph;
}

std::vector<Pose> WindingRoad(int poses) {
  std::vector<Pose> road(static_cast<std::size_t>(poses));
  for (std::size_t i = 1; i < road.size(); ++i) {
    const double turn = 0.08 * std::sin(0.05 * static_cast<double>(i));
    road[i].heading = road[i - 1].heading + turn;
    road[i].x = road[i - 1].x + 2.0 * std::cos(road[i - 1].heading);
    road[i].y = road[i - 1].y + 2.0 * std::sin(road[i - 1].heading);
  }
  return road;
}

// Compares entry by entry, in units of the standard deviations concerned.
template <int D>
void ExpectCovarianceNear(const StateMatrix<D>& actual,
                          const StateMatrix<D>& expected,
                          const StateMatrix<D>& units, double tolerance) {
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      const double unit = std::sqrt(units(r, r) * units(c, c));
      EXPECT_NEAR(actual(r, c) / unit, expected(r, c) / unit, tolerance)
          << "entry " << r << "," << c;
    }
  }
}

TEST(NodeNoiseTest, DeadReckoningMatchesTheCovarianceOfDrawnDrives) {
  std::mt19937_64 random = SeededRandom();
  oracle::Noise noise;
  noise.start_heading_radians = 0.002;
  noise.heading_radians = 0.0002;
  const std::vector<Pose> truth = WindingRoad(200);
  const PoseGraph graph =
      OneNodePerSample(oracle::WithCovariances(truth, noise));
  const int draws = 20000;
  const NodeIndex i = 60;
  const NodeIndex j = 199;
  StateMatrix<3> cross = StateMatrix<3>::Zero();
  StateMatrix<3> of_difference = StateMatrix<3>::Zero();
  for (int draw = 0; draw < draws; ++draw) {
    const std::vector<Pose> estimate =
        oracle::DrawEstimate(truth, noise, random);
    const auto error = [&](NodeIndex k) {
      const auto at = static_cast<std::size_t>(k);
      return ToVector<3>(Difference(estimate[at], truth[at]));
    };
    cross += error(i) * error(j).transpose() / draws;
    const StateVector<3> difference = error(j) - error(i);
    of_difference += difference * difference.transpose() / draws;
  }

  const StateMatrix<3> s_ii = ToMatrix<3>(graph.node(i).covariance);
  const StateMatrix<3> s_jj = ToMatrix<3>(graph.node(j).covariance);
  const StateMatrix<3> s_ij =
      s_ii *
      DeadReckoningTransition<3>(graph.pose(i), graph.pose(j)).transpose();
  // Sample covariances of 20,000 draws are accurate to about 1 / sqrt(20,000) =
  // 0.007 of the standard deviations; allowed is four times that.
  StateMatrix<3> units = StateMatrix<3>::Zero();
  for (int k = 0; k < 3; ++k) {
    units(k, k) = std::sqrt(s_ii(k, k) * s_jj(k, k));
    EXPECT_GT(std::abs(s_ij(k, k)) / units(k, k), 0.05)
        << "a cross-covariance of zero would prove nothing";
  }
  ExpectCovarianceNear<3>(cross, s_ij, s_jj, 0.03);
  const StateMatrix<3> gamma =
      DifferenceCovariance<3>(graph, CorrelationModel::kDeadReckoning, i, j);
  ExpectCovarianceNear<3>(of_difference, gamma, gamma, 0.04);
}

TEST(NodeNoiseTest, FilterMatchesTheCovarianceOfADrawnKalmanFilter) {
  // A SPATIAL filter with error e_j = A_j e_i + w, with w drawn.
  std::mt19937_64 random = SeededRandom();
  const int nodes = 12;
  std::vector<StateMatrix<4>> transitions;
  std::vector<StateMatrix<4>> noise_roots;
  StateMatrix<4> covariance = 0.5 * StateMatrix<4>::Identity();
  PoseGraph graph;
  for (int i = 0; i < nodes; ++i) {
    StateMatrix<4> a = 0.9 * StateMatrix<4>::Identity();
    StateMatrix<4> root = StateMatrix<4>::Zero();
    for (int k = 0; k < 16; ++k) {
      a(k) += Normal(random, 0.1);
      root(k) = Normal(random, 0.2);
    }
    if (i > 0) {
      covariance =
          (a * covariance * a.transpose()).eval() + root * root.transpose();
    }
    transitions.push_back(a);
    noise_roots.push_back(root);
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.covariance = ToCovariance<4>(covariance);
    graph.AddNode(node, i == 0, ToErrorTransition<4>(a));
  }
  const int draws = 40000;
  const NodeIndex i = 4;
  const NodeIndex j = 9;
  StateMatrix<4> of_difference = StateMatrix<4>::Zero();
  const auto draw_normal = [&random] {
    StateVector<4> v;
    for (int k = 0; k < 4; ++k) v(k) = Normal(random, 1.0);
    return v;
  };
  for (int draw = 0; draw < draws; ++draw) {
    StateVector<4> error = std::sqrt(0.5) * draw_normal();
    StateVector<4> at_i = error;
    for (int k = 1; k <= j; ++k) {
      const auto at = static_cast<std::size_t>(k);
      error =
          (transitions[at] * error).eval() + noise_roots[at] * draw_normal();
      if (k == i) at_i = error;
    }
    const StateVector<4> difference = error - at_i;
    of_difference += difference * difference.transpose() / draws;
  }
  const StateMatrix<4> gamma =
      DifferenceCovariance<4>(graph, CorrelationModel::kFilter, i, j);
  ExpectCovarianceNear<4>(of_difference, gamma, gamma, 0.03);
}

TEST(NodeNoiseTest, IndependentAddsTheCovariances) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 5, 0.0, 0, false);
  const StateMatrix<4> gamma =
      DifferenceCovariance<4>(graph, CorrelationModel::kIndependent, 1, 3);
  EXPECT_EQ(gamma, ToMatrix<4>(graph.node(1).covariance) +
                       ToMatrix<4>(graph.node(3).covariance));
}

TEST(NodeNoiseTest, TheOrderOfTheNodesDoesNotMatter) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 8, 0.0, 0, true);
  for (CorrelationModel model :
       {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
        CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes}) {
    EXPECT_EQ(DifferenceCovariance<4>(graph, model, 2, 6),
              DifferenceCovariance<4>(graph, model, 6, 2));
  }
}

TEST(NodeNoiseTest, DeadReckonedNodesNextToEachOtherDifferByTheStepAlone) {
  // After 100 km the uncertainty is hundreds of metres, yet Gamma of two nodes
  // 100 m apart must still hold only what was added between them: the terms
  // that cancel are a million times larger.
  oracle::Noise noise;
  const std::vector<Pose> truth = WindingRoad(50001);
  const PoseGraph graph =
      OneNodePerSample(oracle::WithCovariances(truth, noise));
  const NodeIndex j = 50000;
  const NodeIndex i = j - 50;
  EXPECT_GT(std::sqrt(graph.node(j).covariance(0, 0)), 100.0);
  const StateMatrix<3> gamma =
      DifferenceCovariance<3>(graph, CorrelationModel::kDeadReckoning, i, j);
  EXPECT_EQ(gamma.llt().info(), Eigen::Success);
  EXPECT_NEAR(std::sqrt(gamma(2, 2)), noise.heading_radians * 10.0, 1e-6);
  // Heading noise is independent of the earlier heading, so Gamma's x and y
  // hold the lever arm of the common heading error too; take it out.
  const StateMatrix<3> psi =
      DeadReckoningTransition<3>(graph.pose(i), graph.pose(j));
  const StateMatrix<3> s_ii = ToMatrix<3>(graph.node(i).covariance);
  const StateMatrix<3> lever = (StateMatrix<3>::Identity() - psi) * s_ii *
                               (StateMatrix<3>::Identity() - psi).transpose();
  const StateMatrix<3> added = gamma - lever;
  EXPECT_LT(std::sqrt(added(0, 0)), 1.0);
  EXPECT_GT(added(0, 0), 0.0);
}

// Nodes every 2 m with covariances of one shape, of which each is a multiple.
PoseGraph FixesOfOneShape(const StateMatrix<3>& shape,
                          const std::vector<double>& sigmas) {
  PoseGraph graph;
  for (const double sigma : sigmas) {
    Node node;
    node.travelled_meters = 2.0 * static_cast<double>(graph.size());
    node.covariance = ToCovariance<3>(sigma * sigma * shape);
    graph.AddNode(node, graph.size() == 0, std::nullopt);
  }
  return graph;
}

TEST(NodeNoiseTest, CorrelatedFixesMatchADrawnGaussMarkovProcess) {
  std::mt19937_64 random = SeededRandom();
  const StateMatrix<3> shape = ToMatrix<3>(RandomCovariance(random, 1.0));
  const StateMatrix<3> root = shape.llt().matrixL();
  std::vector<double> sigmas;
  for (int i = 0; i < 40; ++i) sigmas.push_back(Uniform(random, 0.5, 3.0));
  const PoseGraph graph = FixesOfOneShape(shape, sigmas);
  const Correlation correlation(CorrelationModel::kCorrelatedFixes, 60.0);
  const double kept = std::exp(-2.0 / 60.0);
  const NodeIndex i = 7;
  const NodeIndex j = 31;
  const int draws = 40000;
  StateMatrix<3> cross = StateMatrix<3>::Zero();
  StateMatrix<3> of_difference = StateMatrix<3>::Zero();
  for (int draw = 0; draw < draws; ++draw) {
    StateVector<3> white = StateVector<3>::Zero();
    StateVector<3> at_i = white;
    for (int k = 0; k <= j; ++k) {
      const double fresh = k == 0 ? 1.0 : std::sqrt(1.0 - kept * kept);
      for (int c = 0; c < 3; ++c) {
        white(c) =
            (k == 0 ? 0.0 : kept) * white(c) + fresh * Normal(random, 1.0);
      }
      if (k == i) at_i = white;
    }
    const StateVector<3> e_i = sigmas[7] * (root * at_i);
    const StateVector<3> e_j = sigmas[31] * (root * white);
    cross += e_i * e_j.transpose() / draws;
    of_difference += (e_j - e_i) * (e_j - e_i).transpose() / draws;
  }
  const StateMatrix<3> gamma =
      DifferenceCovariance<3>(graph, correlation, i, j);
  ExpectCovarianceNear<3>(of_difference, gamma, gamma, 0.03);
  const StateMatrix<3> units = sigmas[7] * sigmas[31] * shape;
  // The process has no more in common than the model's mean of covariances.
  EXPECT_GT(CrossCovariance<3>(graph, correlation, i, j)(0, 0) / units(0, 0),
            0.3);
  ExpectCovarianceNear<3>(cross + cross.transpose(),
                          2.0 * CrossCovariance<3>(graph, correlation, i, j),
                          units, 0.06);
}

TEST(NodeNoiseTest, CorrelatedFixesThatAreFarApartAreIndependent) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 300, 0.0, 0, false);
  const Correlation correlation(CorrelationModel::kCorrelatedFixes, 5.0);
  EXPECT_EQ(
      DifferenceCovariance<4>(graph, correlation, 1, 200),
      DifferenceCovariance<4>(graph, CorrelationModel::kIndependent, 1, 200));
  BlockShares shares;
  EXPECT_FALSE(FindUncorrelatedShares(graph, correlation, 299, 0, &shares));
  EXPECT_TRUE(FindUncorrelatedShares(graph, correlation, 299, 1, &shares));
  EXPECT_FALSE(FindUncorrelatedShares(graph, CorrelationModel::kIndependent,
                                      299, 1, &shares));
}

TEST(NodeNoiseTest, NeighbouringFixesShareAllOfWhatTheCovariancesAllow) {
  // A receiver that comes out of a tunnel knows more than it did: what it has
  // gained is left in the difference.
  const PoseGraph graph =
      FixesOfOneShape(StateMatrix<3>::Identity(), {1.0, 1.0, 7.0});
  const Correlation correlation(CorrelationModel::kCorrelatedFixes, 1e6);
  EXPECT_NEAR(DifferenceCovariance<3>(graph, correlation, 0, 1)(0, 0), 4e-6,
              1e-9);
  EXPECT_NEAR(DifferenceCovariance<3>(graph, correlation, 1, 2)(0, 0), 36.0,
              1e-3);
}

TEST(NodeNoiseTest, FixesOfAnyTwoCovariancesHaveADefiniteDifference) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const PoseGraph graph = RandomGraph(random, 6, 0.0, 0, false);
    const Correlation correlation(CorrelationModel::kCorrelatedFixes,
                                  Uniform(random, 1.0, 1e4));
    const StateMatrix<4> gamma =
        DifferenceCovariance<4>(graph, correlation, 1, 4);
    EXPECT_EQ(gamma.llt().info(), Eigen::Success);
    const StateMatrix<4> less =
        DifferenceCovariance<4>(graph, CorrelationModel::kIndependent, 1, 4) -
        gamma;
    EXPECT_EQ(less.llt().info(), Eigen::Success);
  }
}

TEST(NodeNoiseTest, LongFilterProductsDecayToZero) {
  PoseGraph graph;
  StateMatrix<4> half = 0.5 * StateMatrix<4>::Identity();
  for (std::uint64_t i = 0; i < 100; ++i) {
    graph.AddNode(Node{}, i == 0, ToErrorTransition<4>(half));
  }
  EXPECT_EQ(CarriedTransition<4>(graph, 0, 99), (StateMatrix<4>::Zero()));
  EXPECT_NEAR((CarriedTransition<4>(graph, 89, 99))(0, 0), std::pow(0.5, 10),
              1e-18);
}

}  // namespace
}  // namespace revisit::core
