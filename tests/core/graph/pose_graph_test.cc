#include "core/graph/pose_graph.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

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

}  // namespace
}  // namespace revisit::core
