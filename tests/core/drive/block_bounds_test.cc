#include "core/drive/block_bounds.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>
#include <set>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);

// A drive that wanders, so that blocks lie apart. next() makes each covariance
// from that of the node before.
PoseGraph Drive(std::mt19937_64& random, NodeIndex nodes,
                const std::function<Covariance(const Node& before,
                                               const Pose& pose)>& next) {
  PoseGraph graph;
  Node node;
  node.covariance = RandomCovariance(random, 0.1);
  for (NodeIndex i = 0; i < nodes; ++i) {
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    graph.AddNode(node, i == 0, std::nullopt);
    Pose pose = node.pose;
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.1));
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
    node.covariance = next(node, pose);
    node.pose = pose;
  }
  return graph;
}

// A drive whose errors stay as they are.
PoseGraph SteadyDrive(std::mt19937_64& random, NodeIndex nodes) {
  return Drive(random, nodes, [](const Node& before, const Pose&) {
    return before.covariance;
  });
}

// A drive by dead reckoning: each error is the one before, carried on, plus
// noise.
template <int D>
Covariance Reckoned(std::mt19937_64& random, const Node& before,
                    const Pose& pose) {
  const StateMatrix<D> psi = DeadReckoningTransition<D>(before.pose, pose);
  return ToCovariance<D>(psi * ToMatrix<D>(before.covariance) *
                             psi.transpose() +
                         ToMatrix<D>(RandomCovariance(random, 0.05)));
}

// Whether the noise added since is positive definite, as the header defines it.
template <int D>
bool NoiseIsAddedFrom(const PoseGraph& graph, NodeIndex j, NodeIndex query) {
  const StateMatrix<D> psi =
      DeadReckoningTransition<D>(graph.pose(j), graph.pose(query));
  const StateMatrix<D> added =
      ToMatrix<D>(graph.covariance(query)) -
      psi * ToMatrix<D>(graph.covariance(j)) * psi.transpose();
  return Eigen::SelfAdjointEigenSolver<StateMatrix<D>>(added)
             .eigenvalues()
             .minCoeff() > 0.0;
}

bool IsWithin(const BlockBounds::Region& region, const Node& node) {
  const Eigen::Vector2d variances =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d>(
          ToMatrix<3>(node.covariance).topLeftCorner<2, 2>())
          .eigenvalues();
  return std::pow(node.pose.x - region.x, 2) +
             std::pow(node.pose.y - region.y, 2) <
         (1.0 - 1e-9) * region.squared_per_variance *
             (region.variance - region.least_taken * variances(0) +
              region.most_added * variances(1));
}

TEST(BlockBoundsTest, BlocksWithNodesInTheRegionAreVisited) {
  std::mt19937_64 random = SeededRandom();
  std::size_t visited_in_all = 0;
  std::size_t held_in_all = 0;
  std::size_t blocks_in_all = 0;
  PoseGraph graph;
  BlockBounds bounds(StateSpace::kPlanar);
  for (int trial = 0; trial < 1000 && !HasFailure(); ++trial) {
    SCOPED_TRACE(trial);
    if (trial % 100 == 0) {
      graph = Drive(
          random, UniformInt(random, 1, 10000), [&](const Node&, const Pose&) {
            return RandomCovariance(random, Uniform(random, 0.1, 5.0));
          });
      bounds = BlockBounds(StateSpace::kPlanar);
      bounds.Extend(graph);
      // All full blocks that are followed by two others.
      ASSERT_EQ(bounds.size(),
                std::max<NodeIndex>((graph.size() - 1) / kBlock - 1, 0));
    }
    const auto blocks = static_cast<int>(bounds.size());
    const auto last = static_cast<std::size_t>(UniformInt(random, 0, blocks));
    const auto first =
        static_cast<std::size_t>(UniformInt(random, 0, static_cast<int>(last)));
    const Pose around =
        graph.pose(UniformInt(random, 0, static_cast<int>(graph.size()) - 1));
    BlockBounds::Region region;
    region.x = around.x + Normal(random, 30.0);
    region.y = around.y + Normal(random, 30.0);
    region.squared_per_variance = std::exp(Uniform(random, 2.0, 6.0));
    region.variance = Uniform(random, 0.0, 20.0);
    (UniformInt(random, 0, 1) ? region.least_taken : region.most_added) =
        Uniform(random, 0.0, 1.0);
    std::vector<std::size_t> visited;
    bounds.VisitNear(region, first, last,
                     [&](std::size_t k) { visited.push_back(k); });
    EXPECT_TRUE(std::is_sorted(visited.rbegin(), visited.rend()));
    const std::set<std::size_t> unique(visited.begin(), visited.end());
    EXPECT_EQ(unique.size(), visited.size());
    for (const std::size_t k : visited) {
      EXPECT_GE(k, first);
      EXPECT_LT(k, last);
    }
    for (std::size_t k = first; k < last; ++k) {
      bool holds = false;
      for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
        holds |= IsWithin(
            region,
            graph.node(static_cast<NodeIndex>(k * NodeBlock::kSize + i)));
      }
      EXPECT_TRUE(!holds || unique.count(k) == 1) << "block " << k;
      held_in_all += holds;
    }
    visited_in_all += visited.size();
    blocks_in_all += last - first;
  }
  std::cout << held_in_all << " blocks hold such nodes, " << visited_in_all
            << " were visited of " << blocks_in_all << "\n";
  EXPECT_GT(held_in_all, 100u);
  // The bounds rule out some blocks.
  EXPECT_LT(visited_in_all, 4 * held_in_all);
  EXPECT_LT(2 * visited_in_all, blocks_in_all);
}

TEST(BlockBoundsTest, GrowingWithTheGraphTellsTheSameAsAllAtOnce) {
  std::mt19937_64 random = SeededRandom();
  PoseGraph graph;
  BlockBounds growing(StateSpace::kPlanar);
  for (NodeIndex i = 0; i < 2000; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.pose = RandomPose(random, 100.0);
    node.covariance = RandomCovariance(random, 1.0);
    graph.AddNode(node, i == 0, std::nullopt);
    if (UniformInt(random, 0, 9) == 0) growing.Extend(graph);
  }
  growing.Extend(graph);
  BlockBounds at_once(StateSpace::kPlanar);
  at_once.Extend(graph);
  ASSERT_EQ(growing.size(), at_once.size());
  for (int trial = 0; trial < 200; ++trial) {
    BlockBounds::Region region;
    region.x = Uniform(random, -150.0, 150.0);
    region.y = Uniform(random, -150.0, 150.0);
    region.squared_per_variance = std::exp(Uniform(random, 0.0, 8.0));
    region.variance = 1.0;
    std::vector<std::size_t> one;
    std::vector<std::size_t> other;
    growing.VisitNear(region, 0, growing.size(),
                      [&](std::size_t k) { one.push_back(k); });
    at_once.VisitNear(region, 0, at_once.size(),
                      [&](std::size_t k) { other.push_back(k); });
    EXPECT_EQ(one, other);
  }
}

TEST(BlockBoundsTest, RegionThatIsNotANumberIsNearEverything) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = SteadyDrive(random, 1000);
  BlockBounds bounds(StateSpace::kPlanar);
  bounds.Extend(graph);
  BlockBounds::Region region;
  region.x = 1e6;
  region.squared_per_variance = std::nan("");
  std::size_t visited = 0;
  bounds.VisitNear(region, 0, bounds.size(), [&](std::size_t) { ++visited; });
  EXPECT_EQ(visited, bounds.size());
}

// From the first growing block on, every node's error has grown to the query's
// as the header says.
template <int D>
void ExpectGrown(const PoseGraph& graph, StateSpace space, NodeIndex query,
                 std::size_t first_wanted, std::size_t first_allowed) {
  BlockBounds bounds(space);
  bounds.Extend(graph);
  std::size_t blocks = bounds.size();
  while (static_cast<NodeIndex>(blocks + 1) * kBlock + 1 > query) --blocks;
  const std::size_t first = bounds.FirstGrowing(graph, query, blocks);
  EXPECT_GE(first, first_wanted);
  EXPECT_LE(first, std::min(first_allowed, blocks));
  for (NodeIndex j = static_cast<NodeIndex>(first) * kBlock;
       j < static_cast<NodeIndex>(blocks) * kBlock; ++j) {
    ASSERT_TRUE(NoiseIsAddedFrom<D>(graph, j, query)) << "node " << j;
  }
}

TEST(BlockBoundsTest, ErrorsOfDeadReckoningGrowFromTheStart) {
  std::mt19937_64 random = SeededRandom();
  const auto planar = [&](const Node& before, const Pose& pose) {
    return Reckoned<3>(random, before, pose);
  };
  const auto spatial = [&](const Node& before, const Pose& pose) {
    return Reckoned<4>(random, before, pose);
  };
  for (int trial = 0; trial < 10 && !HasFailure(); ++trial) {
    ExpectGrown<3>(Drive(random, 1500, planar), StateSpace::kPlanar, 1499, 0,
                   0);
    ExpectGrown<4>(Drive(random, 1500, spatial), StateSpace::kSpatial, 1499, 0,
                   0);
  }
}

TEST(BlockBoundsTest, AFixOnTheWayEndsTheGrowthBeforeIt) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 20 && !HasFailure(); ++trial) {
    const auto fixed = static_cast<std::uint64_t>(UniformInt(random, 300, 700));
    const PoseGraph graph =
        Drive(random, 1500, [&](const Node& before, const Pose& pose) {
          if (before.sequence == fixed) return RandomCovariance(random, 1e-3);
          return Reckoned<3>(random, before, pose);
        });
    const std::size_t block = fixed / NodeBlock::kSize;
    // The two blocks after the fix show whether errors grew over it.
    ExpectGrown<3>(graph, StateSpace::kPlanar, 1499, block - 2, block + 2);
  }
}

TEST(BlockBoundsTest, ErrorsThatStayAsTheyAreDoNotGrow) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = SteadyDrive(random, 1000);
  BlockBounds bounds(StateSpace::kPlanar);
  bounds.Extend(graph);
  const std::size_t blocks = bounds.size() - 2;
  EXPECT_EQ(bounds.FirstGrowing(graph, 999, blocks), blocks);
  EXPECT_EQ(bounds.FirstGrowing(graph, 999, 0), 0u);
}

}  // namespace
}  // namespace revisit::core
