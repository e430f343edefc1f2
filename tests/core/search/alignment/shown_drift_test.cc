#include "core/search/alignment/shown_drift.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <vector>

#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/differences.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/known_drift.h"
#include "tests/oracle/dead_reckoning.h"

namespace revisit::core {
namespace {

constexpr NodeIndex kLap = 400;

// Two laps of a square of 200 m, a node each 2 m, by a gyro that errs by so
// much on each metre. What is claimed is a random walk of some 16 degrees a
// lap.
PoseGraph TwoLaps(double bias) {
  std::vector<Pose> estimate;
  Pose pose;
  for (NodeIndex i = 0; i < 2 * kLap; ++i) {
    estimate.push_back(pose);
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
    const double turn = (i + 1) % (kLap / 4) == 0 ? 0.5 * kPi : 0.0;
    pose.heading = WrapHeading(pose.heading + turn + 2.0 * bias);
  }
  oracle::Noise noise;
  noise.heading_radians = 0.01;
  PoseGraph graph;
  NodeIndex i = 0;
  for (const PoseSample& sample : oracle::WithCovariances(estimate, noise)) {
    Node node;
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    graph.AddNode(node, i == 0, std::nullopt);
    ++i;
  }
  return graph;
}

ConfirmedLoop LapAfter(NodeIndex matched) {
  return {matched + kLap, matched, nullptr};
}

double MetersApart(const Pose& a, const Pose& b) {
  return std::hypot(a.x - b.x, a.y - b.y);
}

TEST(ShownDriftTest, CarriesThePastToWhereTheDriveNowSeesIt) {
  // 23 degrees a lap.
  const PoseGraph graph = TwoLaps(5e-4);
  const Query query{graph, 750};
  const SimilarityModel model;
  const std::vector<ConfirmedLoop> pairs = {LapAfter(20), LapAfter(60),
                                            LapAfter(90)};
  const auto shown = ShownDrift<3>::Make(query, model, pairs);
  ASSERT_TRUE(shown);
  // Half a lap after the newest pair.
  const NodeIndex matched = 750 - kLap;
  const Pose placed = Compose(shown->tie().transform, graph.pose(matched));
  EXPECT_LT(MetersApart(graph.pose(750), placed), 6.0);

  // A linear update leaves far more, which is why there is another.
  const auto known = KnownDrift<3>::Make(query, model, pairs.back());
  ASSERT_TRUE(known);
  StateVector<3> difference =
      ToVector<3>(Difference(graph.pose(750), graph.pose(matched)));
  StateMatrix<3> covariance = StateMatrix<3>::Identity();
  known->Apply(matched, &difference, &covariance);
  EXPECT_GT(std::hypot(difference(0), difference(1)), 15.0);
}

TEST(ShownDriftTest, PairsTogetherAreSurerThanOneOfThem) {
  const PoseGraph graph = TwoLaps(1e-4);
  const Query query{graph, 750};
  const auto one = ShownDrift<3>::Make(query, {}, {LapAfter(90)});
  const auto three = ShownDrift<3>::Make(
      query, {}, {LapAfter(20), LapAfter(60), LapAfter(90)});
  ASSERT_TRUE(one && three);
  EXPECT_EQ(one->tie().asking_node, NodeIndex{490});
  EXPECT_EQ(three->tie().asking_node, NodeIndex{490});
  for (int k : {0, 1, 3}) {
    EXPECT_GT(three->tie().fixed(k, k), 0.0);
    EXPECT_LT(three->tie().fixed(k, k), 0.8 * one->tie().fixed(k, k));
  }
}

TEST(ShownDriftTest, APairThatContradictsThoseBeforeBeginsAnew) {
  const PoseGraph graph = TwoLaps(1e-4);
  const Query query{graph, 750};
  // Half a side away from where it is.
  const ConfirmedLoop other{490, 40, nullptr};
  const auto alone = ShownDrift<3>::Make(query, {}, {other});
  const auto after =
      ShownDrift<3>::Make(query, {}, {LapAfter(20), LapAfter(60), other});
  ASSERT_TRUE(alone && after);
  EXPECT_EQ(after->tie().transform.x, alone->tie().transform.x);
  EXPECT_EQ(after->tie().transform.heading, alone->tie().transform.heading);
  EXPECT_EQ(after->tie().fixed, alone->tie().fixed);
}

TEST(ShownDriftTest, APlacePassedTheOtherWayTurnsNothing) {
  // There and back on one road.
  std::vector<Pose> path;
  for (int i = 0; i < 100; ++i) path.push_back({2.0 * i, 0.0, 0.0, 0.0});
  for (int i = 0; i < 100; ++i)
    path.push_back({200.0 - 2.0 * i, 0.0, 0.0, kPi});
  PoseGraph graph;
  for (const PoseSample& sample : oracle::WithCovariances(path, {})) {
    Node node;
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    graph.AddNode(node, graph.size() == 0, std::nullopt);
  }
  const auto shown =
      ShownDrift<3>::Make({graph, 190}, {}, {{150, 50, nullptr}});
  ASSERT_TRUE(shown);
  EXPECT_NEAR(shown->tie().transform.heading, 0.0, 1e-9);
}

TEST(ShownDriftTest, PairsWhoseCovariancesDoNotGrowDoNotCount) {
  const PoseGraph growing = TwoLaps(1e-4);
  PoseGraph graph;
  for (NodeIndex i = 0; i < growing.size(); ++i) {
    Node node = growing.node(i);
    // An optimiser leaves nodes surer than those that came before.
    if (i >= 450) node.covariance = growing.node(10).covariance;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  EXPECT_TRUE(ShownDrift<3>::Make({graph, 440}, {}, {LapAfter(30)}));
  // Between the two nodes of the pair, and between these and the query.
  EXPECT_FALSE(ShownDrift<3>::Make({graph, 750}, {}, {LapAfter(90)}));
  EXPECT_FALSE(ShownDrift<3>::Make({graph, 750}, {}, {LapAfter(30)}));
}

TEST(ShownDriftTest, NodesShortOfTheMarkHaveItsDriftAlready) {
  const PoseGraph graph = TwoLaps(5e-4);
  const Query query{graph, 500};
  const SimilarityModel model;
  const History history{graph, 490};
  // The pair spans a lap, and with it a drift of some 40 m.
  const auto shown = ShownDrift<3>::Make(query, model, {LapAfter(90)});
  ASSERT_TRUE(shown);
  const Pose turned = Compose(shown->tie().transform, graph.pose(480));
  EXPECT_GT(MetersApart(turned, graph.pose(480)), 40.0);
  Differences<3> differences(query, history, model, *shown);
  DifferenceBlock block;
  // Nodes 384 to 489.
  differences.Find(3, 490 - 384, 3, &block);
  const std::size_t at = 480 - 384;
  EXPECT_NEAR(std::hypot(block.difference[0][at], block.difference[1][at]),
              MetersApart(graph.pose(500), graph.pose(480)), 5.0);
}

}  // namespace
}  // namespace revisit::core
