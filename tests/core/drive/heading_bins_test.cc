#include "core/drive/heading_bins.h"

#include <gtest/gtest.h>

#include <cstdint>
#include <optional>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

PoseGraph Headed(const std::vector<double>& headings) {
  PoseGraph graph;
  for (const double heading : headings) {
    Node node;
    node.pose.heading = heading;
    graph.AddNode(node, graph.size() == 0, std::nullopt);
  }
  return graph;
}

TEST(HeadingBinsTest, AFullTurnIsTwoHundredAndFiftySixBins) {
  HeadingBins bins;
  bins.Extend(Headed({0.0, 0.5 * kPi, kPi, -0.5 * kPi, -2.0 * kPi / 256.0}));
  EXPECT_EQ(bins.bins(), (std::vector<std::uint8_t>{0, 64, 128, 192, 255}));
}

TEST(HeadingBinsTest, DifferencesWrapAsHeadingsDo) {
  HeadingBins bins;
  bins.Extend(Headed({kPi - 0.1, -kPi + 0.1}));
  const auto turn = static_cast<std::int8_t>(bins.bins()[1] - bins.bins()[0]);
  EXPECT_NEAR(turn, InHeadingBins(0.2), 1.0);
}

TEST(HeadingBinsTest, GrowsWithTheGraph) {
  HeadingBins bins;
  PoseGraph graph = Headed({0.0});
  bins.Extend(graph);
  Node node;
  node.pose.heading = 0.5 * kPi;
  graph.AddNode(node, false, std::nullopt);
  bins.Extend(graph);
  EXPECT_EQ(bins.size(), 2);
  EXPECT_EQ(bins.bins().back(), 64);
}

}  // namespace
}  // namespace revisit::core
