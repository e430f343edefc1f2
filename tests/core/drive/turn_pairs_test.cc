#include "core/drive/turn_pairs.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>
#include <random>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "tests/core/graphs.h"
#include "tests/oracle/motion_by_loops.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// Nodes that turn by these angles from one to the next.
PoseGraph Turning(const std::vector<double>& turns) {
  PoseGraph graph;
  double heading = 0.0;
  for (std::size_t i = 0; i <= turns.size(); ++i) {
    Node node;
    node.sequence = i + 1;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose.heading = WrapHeading(heading);
    graph.AddNode(node, i == 0, std::nullopt);
    if (i < turns.size()) heading += turns[i];
  }
  return graph;
}

TEST(TurnPairsTest, CountsWhatLoopsOverAllPairsCount) {
  std::mt19937_64 random = SeededRandom();
  int with_pairs = 0;
  for (int trial = 0; trial < 300; ++trial) {
    const NodeIndex size = UniformInt(random, 2, 200);
    const PoseGraph graph =
        RandomGraph(random, size, 0.05, UniformInt(random, 0, 4), true);
    const NodeIndex stretch = UniformInt(random, 1, 12);
    TurnBins bins(stretch);
    bins.Extend(graph);
    ASSERT_EQ(bins.size(), graph.size());
    const NodeIndex last =
        UniformInt(random, 0, static_cast<int>(graph.size()) - 1);
    const TurnPairs pairs(bins, last);
    for (int k = 0; k < 10; ++k) {
      const double turn = Uniform(random, -kPi, kPi);
      const double later = Uniform(random, -kPi, kPi);
      const double share = std::exp(Uniform(random, std::log(1e-5), 0.0));
      const double found = pairs.Share(turn, later, share);
      EXPECT_NEAR(found,
                  static_cast<double>(oracle::PairShareByLoops(
                      graph, last, stretch, turn, later, share)),
                  1e-12)
          << size << " nodes to " << last << ", stretches of " << stretch;
      EXPECT_GT(found, 0.0);
      EXPECT_LE(found, 1.0);
      with_pairs += found != 1.0 / (1.0 / std::max(1e-3, share));
    }
  }
  EXPECT_GT(with_pairs, 100);
}

TEST(TurnPairsTest, MakesTheNextCornerOfAGridNoSurprise) {
  // Right angles all the way: straight, corner, straight, corner.
  std::vector<double> turns;
  for (int corner = 0; corner < 100; ++corner) {
    turns.insert(turns.end(), {0.0, 0.0, 0.0, 0.5 * kPi});
  }
  const PoseGraph graph = Turning(turns);
  TurnBins bins(2);
  bins.Extend(graph);
  const TurnPairs pairs(bins, graph.size() - 1);
  // Every corner is followed by a straight, half of all straights by a corner.
  EXPECT_GT(pairs.Share(0.5 * kPi, 0.0, 0.5), 0.45);
  EXPECT_LT(pairs.Share(0.5 * kPi, 0.5 * kPi, 0.5), 0.05);
}

TEST(TurnPairsTest, TakesTheShareOfAllStretchesWhereThereIsNoPair) {
  const PoseGraph graph = Turning({0.1, 0.1, 0.1});
  TurnBins bins(2);
  bins.Extend(graph);
  EXPECT_DOUBLE_EQ(TurnPairs(bins, 2).Share(0.2, 0.2, 0.25), 0.25);
}

TEST(TurnPairsTest, TakesHalfATurnEitherWayForTheSame) {
  EXPECT_EQ(TurnBin(kPi), TurnBin(-kPi));
  EXPECT_EQ(TurnBin(0.0), 0);
  EXPECT_EQ(TurnBin(-1e-9), 0);
  EXPECT_EQ(TurnBin(2.0 * kPi / kTurnBins), 1);
  EXPECT_EQ(TurnBin(-2.0 * kPi / kTurnBins), kTurnBins - 1);
}

TEST(TurnPairsTest, ExtendsAsTheGraphGrows) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph whole = RandomGraph(random, 150, 0.05, 3, true);
  PoseGraph graph;
  TurnBins growing(5);
  for (NodeIndex i = 0; i < whole.size(); ++i) {
    graph.AddNode(whole.node(i), whole.SegmentStart(i) == i, std::nullopt);
    if (UniformInt(random, 0, 9) == 0) growing.Extend(graph);
  }
  growing.Extend(graph);
  TurnBins at_once(5);
  at_once.Extend(graph);
  EXPECT_EQ(growing.bins(), at_once.bins());
}

}  // namespace
}  // namespace revisit::core
