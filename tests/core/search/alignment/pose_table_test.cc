#include "core/search/alignment/pose_table.h"

#include <gtest/gtest.h>

#include "core/drive/pose_graph.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

void ExpectPoseOf(const PoseGraph& graph, const PoseTable& table, NodeIndex i) {
  const double* const entry = table.poses() + 4 * i;
  const Pose pose = graph.pose(i);
  EXPECT_EQ(entry[0], pose.x) << i;
  EXPECT_EQ(entry[1], pose.y) << i;
  EXPECT_EQ(entry[2], pose.z) << i;
  EXPECT_EQ(entry[3], pose.heading) << i;
}

TEST(PoseTableTest, HasThePosesOfTheNodesThatAreNeeded) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 700, 0.0, 0, false);
  PoseTable table(graph, 500);
  // Reaches beyond both ends.
  table.Need(-100, 20);
  table.Need(300, 900);
  for (const NodeIndex i : {0, 20, 300, 383, 384, 499}) {
    ExpectPoseOf(graph, table, i);
  }
}

TEST(PoseTableTest, HasAllItsNodesAndNoMoreWhateverItsSize) {
  constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 3 * kBlock, 0.0, 0, false);
  NodeIndex compared = 0;
  // A table is empty where a search has no history.
  constexpr NodeIndex kSizes[] = {0, 1, kBlock - 1, kBlock, kBlock + 1};
  for (const NodeIndex size : kSizes) {
    PoseTable table(graph, size);
    table.Need(-5, 3 * kBlock);
    for (NodeIndex i = 0; i < size; ++i, ++compared) {
      ExpectPoseOf(graph, table, i);
    }
  }
  EXPECT_EQ(compared, 1 + 3 * kBlock);
}

}  // namespace
}  // namespace revisit::core
