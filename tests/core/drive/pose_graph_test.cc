#include "core/drive/pose_graph.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <optional>
#include <random>
#include <vector>

#include "core/geometry/pose.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;
using ::testing::Pair;

Node At(std::uint64_t sequence, double fraction) {
  Node node;
  node.sequence = sequence;
  node.fraction = fraction;
  return node;
}

TEST(PoseGraphTest, FindsTheLastNodeAtOrBeforeAPose) {
  PoseGraph graph;
  graph.AddNode(At(2, 0.0), true, std::nullopt);
  graph.AddNode(At(2, 0.5), false, std::nullopt);
  graph.AddNode(At(5, 0.25), false, std::nullopt);
  EXPECT_EQ(graph.NodeAtOrBefore(1), std::nullopt);
  EXPECT_EQ(graph.NodeAtOrBefore(2), 0);
  EXPECT_EQ(graph.NodeAtOrBefore(3), 1);
  EXPECT_EQ(graph.NodeAtOrBefore(5), 1);
  EXPECT_EQ(graph.NodeAtOrBefore(6), 2);
  EXPECT_EQ(graph.NodeAtOrBefore(1000), 2);
}

TEST(PoseGraphTest, KnowsTheSegmentOfANode) {
  PoseGraph graph;
  for (int i = 0; i < 6; ++i) {
    graph.AddNode(At(static_cast<std::uint64_t>(i) + 1, 0.0), i == 0 || i == 4,
                  std::nullopt);
  }
  EXPECT_EQ(graph.SegmentStart(0), 0);
  EXPECT_EQ(graph.SegmentStart(3), 0);
  EXPECT_EQ(graph.SegmentStart(4), 4);
  EXPECT_EQ(graph.SegmentStart(5), 4);
}

TEST(PoseGraphTest, LoopEdgesCountOncePerAdditionAndGoOneByOne) {
  PoseGraph graph;
  for (std::uint64_t i = 1; i <= 9; ++i) {
    graph.AddNode(At(i, 0.0), i == 1, std::nullopt);
  }
  graph.AddLoopEdge(8, 1);
  graph.AddLoopEdge(1, 8);
  graph.AddLoopEdge(1, 5);
  EXPECT_THAT(graph.LoopNeighbours(1), ElementsAre(8, 8, 5));
  EXPECT_THAT(graph.LoopEdges(),
              ElementsAre(Pair(1, 5), Pair(1, 8), Pair(1, 8)));
  EXPECT_TRUE(graph.RemoveLoopEdge(8, 1));
  EXPECT_THAT(graph.LoopNeighbours(8), ElementsAre(1));
  EXPECT_TRUE(graph.RemoveLoopEdge(1, 8));
  EXPECT_FALSE(graph.RemoveLoopEdge(1, 8));
  EXPECT_THAT(graph.LoopNeighbours(8), IsEmpty());
  EXPECT_THAT(graph.LoopEdges(), ElementsAre(Pair(1, 5)));
}

TEST(PoseGraphTest, TransitionsAreTheIdentityWhereNoneWasGiven) {
  PoseGraph graph;
  graph.AddNode(At(1, 0.0), true, std::nullopt);
  EXPECT_EQ(graph.transition(0).values, ErrorTransition{}.values);
}

TEST(PoseGraphTest, TransitionsAreKeptToTheLastBitAcrossBlocks) {
  std::mt19937_64 random = SeededRandom();
  std::vector<ErrorTransition> given;
  PoseGraph graph;
  for (std::uint64_t i = 0; i < 2 * NodeBlock::kSize + 5; ++i) {
    ErrorTransition transition;
    for (std::size_t k = 0; k < transition.values.size(); ++k) {
      // Some entries constant, some of either sign.
      if (k % 3 != 0) transition.values[k] = Normal(random, 1.0);
    }
    graph.AddNode(At(i + 1, 0.0), i == 0, transition);
    given.push_back(transition);
  }
  std::vector<ErrorTransition> read;
  for (std::size_t i = 0; i < given.size(); ++i) {
    const std::size_t at = i % NodeBlock::kSize;
    if (at == 0) graph.ReadTransitions(i / NodeBlock::kSize, &read);
    EXPECT_EQ(graph.transition(static_cast<NodeIndex>(i)).values,
              given[i].values);
    EXPECT_EQ(read[at].values, given[i].values);
  }
}

TEST(PoseGraphTest, ZIsKeptWhereverItComesIn) {
  // The first nodes of the block have no z, so room for it must be made later.
  PoseGraph graph;
  for (int i = 0; i < 20; ++i) {
    Node node = At(static_cast<std::uint64_t>(i) + 1, 0.0);
    node.pose = {1.0 * i, 2.0 * i, i < 11 ? 0.0 : 3.0 * i, 0.01 * i};
    node.covariance(0, 0) = 1.0 + i;
    node.covariance(2, 3) = i == 15 ? 0.5 : 0.0;
    graph.AddNode(node, i == 0, std::nullopt);
    EXPECT_EQ(graph.block(0).spatial(), i >= 11);
  }
  for (int i = 0; i < 20; ++i) {
    const Node node = graph.node(i);
    EXPECT_EQ(node.pose.x, 1.0 * i);
    EXPECT_EQ(node.pose.y, 2.0 * i);
    EXPECT_EQ(node.pose.z, i < 11 ? 0.0 : 3.0 * i);
    EXPECT_EQ(node.pose.heading, 0.01 * i);
    EXPECT_EQ(graph.pose(i).z, node.pose.z);
    EXPECT_EQ(node.covariance(0, 0), 1.0 + i);
    EXPECT_EQ(node.covariance(2, 3), i == 15 ? 0.5 : 0.0);
  }
}

TEST(PoseGraphTest, NodesKeepTheirPlaceAcrossBlocks) {
  std::mt19937_64 random = SeededRandom();
  std::vector<Node> nodes;
  PoseGraph graph;
  for (std::uint64_t i = 0; i < 3 * NodeBlock::kSize + 1; ++i) {
    Node node;
    node.sequence = 2 * i + 1;
    node.fraction = i % 3 == 0 ? 0.0 : Uniform(random, 0.0, 1.0);
    if (i % 2 == 0) node.stamp_ns = static_cast<std::int64_t>(i) - 100;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose = {Normal(random, 1.0), Normal(random, 1.0), Normal(random, 1.0),
                 Normal(random, 1.0)};
    for (double& entry : node.covariance.upper) entry = Normal(random, 1.0);
    graph.AddNode(node, i == 0, std::nullopt);
    nodes.push_back(node);
  }
  ASSERT_EQ(graph.size(), static_cast<NodeIndex>(nodes.size()));
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const Node node = graph.node(static_cast<NodeIndex>(i));
    EXPECT_EQ(node.sequence, nodes[i].sequence);
    EXPECT_EQ(node.fraction, nodes[i].fraction);
    EXPECT_EQ(node.stamp_ns, nodes[i].stamp_ns);
    EXPECT_EQ(node.travelled_meters, nodes[i].travelled_meters);
    EXPECT_EQ(node.pose.x, nodes[i].pose.x);
    EXPECT_EQ(node.pose.y, nodes[i].pose.y);
    EXPECT_EQ(node.pose.z, nodes[i].pose.z);
    EXPECT_EQ(node.pose.heading, nodes[i].pose.heading);
    EXPECT_EQ(node.covariance.upper, nodes[i].covariance.upper);
    const bool at_pose = nodes[i].fraction == 0.0;
    const auto found = graph.NodeAtOrBefore(nodes[i].sequence);
    EXPECT_EQ(found.value_or(-1), static_cast<NodeIndex>(i) - !at_pose);
  }
}

Node SomeNode(std::uint64_t i) {
  Node node = At(i + 1, 0.25);
  node.travelled_meters = 2.0 * static_cast<double>(i);
  if (i % 2 == 0) node.stamp_ns = static_cast<std::int64_t>(i);
  node.pose = {1.0 * static_cast<double>(i), 5.0, 0.0, 0.5};
  node.covariance(0, 0) = 1.0 + static_cast<double>(i);
  return node;
}

void ExpectSomeNodes(const PoseGraph& graph, std::uint64_t first,
                     std::uint64_t last) {
  for (std::uint64_t i = first; i < last; ++i) {
    const Node node = graph.node(static_cast<NodeIndex>(i));
    const Node expected = SomeNode(i);
    EXPECT_EQ(node.sequence, expected.sequence);
    EXPECT_EQ(node.fraction, expected.fraction);
    EXPECT_EQ(node.travelled_meters, expected.travelled_meters);
    EXPECT_EQ(node.stamp_ns, expected.stamp_ns);
    EXPECT_EQ(node.pose.x, expected.pose.x);
    EXPECT_EQ(node.covariance.upper, expected.covariance.upper);
  }
}

TEST(PoseGraphTest, ACopyStaysAsTheGraphWas) {
  constexpr std::uint64_t kEnd = 5 * NodeBlock::kSize;
  for (const std::uint64_t then :
       {std::uint64_t{1}, NodeBlock::kSize - 1, NodeBlock::kSize,
        NodeBlock::kSize + 1, 3 * NodeBlock::kSize + 7}) {
    PoseGraph graph;
    for (std::uint64_t i = 0; i < then; ++i) {
      graph.AddNode(SomeNode(i), i % 50 == 0, std::nullopt);
    }
    if (then > 9) graph.AddLoopEdge(8, 1);
    const PoseGraph copy = graph;
    for (std::uint64_t i = then; i < kEnd; ++i) {
      graph.AddNode(SomeNode(i), i % 50 == 0, std::nullopt);
    }
    if (then > 9) graph.RemoveLoopEdge(8, 1);
    graph.AddLoopEdge(7, static_cast<NodeIndex>(kEnd) - 1);

    ASSERT_EQ(copy.size(), static_cast<NodeIndex>(then));
    ExpectSomeNodes(copy, 0, then);
    EXPECT_EQ(copy.SegmentEnd(copy.size() - 1), copy.size());
    EXPECT_EQ(copy.NodeAtOrBefore(kEnd), copy.size() - 1);
    EXPECT_EQ(copy.LoopEdges().size(), then > 9 ? 1u : 0u);
    ExpectSomeNodes(graph, 0, kEnd);
    EXPECT_THAT(graph.LoopEdges(),
                ElementsAre(Pair(7, static_cast<NodeIndex>(kEnd) - 1)));
  }
}

TEST(PoseGraphTest, AGraphAndItsCopyGrowApart) {
  PoseGraph graph;
  for (std::uint64_t i = 0; i < NodeBlock::kSize + 3; ++i) {
    graph.AddNode(SomeNode(i), i == 0, std::nullopt);
  }
  PoseGraph copy = graph;
  for (std::uint64_t i = NodeBlock::kSize + 3; i < 3 * NodeBlock::kSize; ++i) {
    graph.AddNode(SomeNode(i), false, std::nullopt);
    copy.AddNode(SomeNode(i + 1000), false, std::nullopt);
  }
  ExpectSomeNodes(graph, 0, 3 * NodeBlock::kSize);
  ExpectSomeNodes(copy, 0, NodeBlock::kSize + 3);
  for (NodeIndex i = NodeBlock::kSize + 3; i < copy.size(); ++i) {
    EXPECT_EQ(copy.node(i).sequence, graph.node(i).sequence + 1000);
    EXPECT_EQ(copy.pose(i).x, graph.pose(i).x + 1000.0);
  }
}

}  // namespace
}  // namespace revisit::core
