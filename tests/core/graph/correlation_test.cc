#include "core/graph/correlation.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <vector>

#include "core/geometry/heading.h"
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

TEST(CorrelationTest, DeadReckoningMatchesTheCovarianceOfDrawnDrives) {
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
      s_ii * PropagatedError<3>(graph, CorrelationModel::kDeadReckoning, i, j)
                 .transpose();
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

TEST(CorrelationTest, FilterMatchesTheCovarianceOfADrawnKalmanFilter) {
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

TEST(CorrelationTest, IndependentAddsTheCovariances) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 5, 0.0, 0, false);
  const StateMatrix<4> gamma =
      DifferenceCovariance<4>(graph, CorrelationModel::kIndependent, 1, 3);
  EXPECT_EQ(gamma, ToMatrix<4>(graph.node(1).covariance) +
                       ToMatrix<4>(graph.node(3).covariance));
}

TEST(CorrelationTest, TheOrderOfTheNodesDoesNotMatter) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 8, 0.0, 0, true);
  for (CorrelationModel model :
       {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
        CorrelationModel::kFilter}) {
    EXPECT_EQ(DifferenceCovariance<4>(graph, model, 2, 6),
              DifferenceCovariance<4>(graph, model, 6, 2));
  }
}

TEST(CorrelationTest, DeadReckonedNodesNextToEachOtherDifferByTheStepAlone) {
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
      PropagatedError<3>(graph, CorrelationModel::kDeadReckoning, i, j);
  const StateMatrix<3> s_ii = ToMatrix<3>(graph.node(i).covariance);
  const StateMatrix<3> lever = (StateMatrix<3>::Identity() - psi) * s_ii *
                               (StateMatrix<3>::Identity() - psi).transpose();
  const StateMatrix<3> added = gamma - lever;
  EXPECT_LT(std::sqrt(added(0, 0)), 1.0);
  EXPECT_GT(added(0, 0), 0.0);
}

TEST(CorrelationTest, LongFilterProductsDecayToZero) {
  PoseGraph graph;
  StateMatrix<4> half = 0.5 * StateMatrix<4>::Identity();
  for (std::uint64_t i = 0; i < 100; ++i) {
    graph.AddNode(Node{}, i == 0, ToErrorTransition<4>(half));
  }
  EXPECT_EQ(PropagatedError<4>(graph, CorrelationModel::kFilter, 0, 99),
            (StateMatrix<4>::Zero()));
  EXPECT_NEAR(
      (PropagatedError<4>(graph, CorrelationModel::kFilter, 89, 99))(0, 0),
      std::pow(0.5, 10), 1e-18);
}

}  // namespace
}  // namespace revisit::core
