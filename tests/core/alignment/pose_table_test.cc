#include "core/alignment/pose_table.h"

#include <gtest/gtest.h>

#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

TEST(PoseTableTest, HasThePosesOfTheNodesThatAreNeeded) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 700, 0.0, 0, false);
  PoseTable table(graph, 500);
  // Reaches beyond both ends.
  table.Need(-100, 20);
  table.Need(300, 900);
  for (const NodeIndex i : {0, 20, 300, 383, 384, 499}) {
    const double* const entry = table.poses() + 4 * i;
    const Pose pose = graph.pose(i);
    EXPECT_EQ(entry[0], pose.x) << i;
    EXPECT_EQ(entry[1], pose.y) << i;
    EXPECT_EQ(entry[2], pose.z) << i;
    EXPECT_EQ(entry[3], pose.heading) << i;
  }
}

TEST(PoseTableTest, MayBeEmpty) {
  const PoseGraph graph;
  PoseTable table(graph, 0);
  table.Need(-5, 5);
}

}  // namespace
}  // namespace revisit::core
