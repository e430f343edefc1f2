#include "core/search/candidates/same_place.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "tests/oracle/wide_state.h"

namespace revisit::core {
namespace {

// Two passes of a straight, 100 nodes each, the second `apart` metres beside
// the first.
PoseGraph TwoPasses(double apart, double deviation) {
  PoseGraph graph;
  for (int i = 0; i < 200; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    node.pose = {2.0 * (i % 100), i < 100 ? 0.0 : apart, 0.0, 0.0};
    for (int k : {0, 1}) node.covariance(k, k) = deviation * deviation;
    node.covariance(3, 3) = 1e-4;
    graph.AddNode(node, i % 100 == 0, std::nullopt);
  }
  return graph;
}

RelativeModel IndependentModel() {
  RelativeModel model;
  model.similarity.correlation = CorrelationModel::kIndependent;
  return model;
}

TEST(SamePlaceTest, NodesNextToEachOtherAreNoTwoPasses) {
  const PoseGraph graph = TwoPasses(0.0, 1.0);
  EXPECT_EQ(SamePlaceProbability(graph, IndependentModel(), 50, 50, 0.0), 0.0);
  EXPECT_EQ(SamePlaceProbability(graph, IndependentModel(), 50, 60, 0.0), 0.0);
}

TEST(SamePlaceTest, WhatAClosureJoinsNearbyIsOnePlace) {
  PoseGraph graph = TwoPasses(80.0, 1.0);
  EXPECT_LT(SamePlaceProbability(graph, IndependentModel(), 50, 150, 0.0),
            1e-9);
  graph.AddLoopEdge(154, 53);
  EXPECT_EQ(SamePlaceProbability(graph, IndependentModel(), 50, 150, 0.0), 1.0);
  EXPECT_EQ(SamePlaceProbability(graph, IndependentModel(), 150, 50, 0.0), 1.0);
  EXPECT_LT(SamePlaceProbability(graph, IndependentModel(), 40, 140, 0.0),
            1e-9);
}

TEST(SamePlaceTest, IsTheLogisticOfTheOdds) {
  for (const double apart : {0.0, 5.0, 20.0}) {
    for (const double ratio : {0.0, 30.0}) {
      const PoseGraph graph = TwoPasses(apart, 4.0);
      const RelativeModel model = IndependentModel();
      oracle::WideVector d(3);
      d << 0.0L, apart, 0.0L;
      const auto form = oracle::EvaluateWide(
          oracle::WideGamma(graph, CorrelationModel::kIndependent, 50, 150, 3) +
              oracle::WideDiagonal(model.similarity.tolerance.position_meters,
                                   model.similarity.tolerance.heading_radians,
                                   3),
          d);
      // Roads 200 m apart with nodes every 2 m, driven either way.
      const double density = 2.0 / 200.0 / 2.0 * 2.0 / (2.0 * kPi);
      const double odds = static_cast<double>(
          std::exp(-0.5L * (form->squared + form->log_determinant +
                            3.0L * std::log(2.0L * oracle::kWidePi)) -
                   std::log(density) + 0.1L * ratio));
      EXPECT_NEAR(SamePlaceProbability(graph, model, 50, 150, ratio),
                  odds / (1.0 + odds), 1e-9);
    }
  }
}

TEST(SamePlaceTest, OppositePassesAreTwoPlaces) {
  PoseGraph graph;
  for (int i = 0; i < 200; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    node.pose = {i < 100 ? 2.0 * i : 2.0 * (199 - i), 0.0, 0.0,
                 i < 100 ? 0.0 : kPi};
    for (int k : {0, 1, 3}) node.covariance(k, k) = 1e-4;
    graph.AddNode(node, i % 100 == 0, std::nullopt);
  }
  graph.AddLoopEdge(50, 149);
  EXPECT_LT(SamePlaceProbability(graph, IndependentModel(), 50, 149, 20.0),
            1e-9);
}

// The nodes of two drives, of which the other one has a known scale.
class SamePlaceAcrossTest : public testing::Test {
 protected:
  double Probability(const std::vector<ConfirmedLoop>& links, NodeIndex i,
                     NodeIndex j, double scale = 1.0) const {
    const FrameNodes asking{asked_, StateSpace::kPlanar,
                            CorrelationModel::kIndependent};
    FrameNodes other{found_, StateSpace::kPlanar,
                     CorrelationModel::kIndependent, scale};
    FrameRelation relation;
    relation.state = FrameState::kDatum;
    relation.transform.y = 20.0;
    return SamePlaceAcross({asking, other}, relation, links, IndependentModel(),
                           i, j, 0.0);
  }

 private:
  const PoseGraph asked_ = TwoPasses(80.0, 1.0);
  const PoseGraph found_ = TwoPasses(80.0, 1.0);
};

TEST_F(SamePlaceAcrossTest, WhatALinkJoinsNearbyIsOnePlace) {
  EXPECT_LT(Probability({}, 50, 50), 1e-9);
  EXPECT_EQ(Probability({{54, 47, nullptr}}, 50, 50), 1.0);
  EXPECT_LT(Probability({{54, 44, nullptr}}, 50, 50), 1e-9);
  EXPECT_LT(Probability({{56, 47, nullptr}}, 50, 50), 1e-9);
}

TEST_F(SamePlaceAcrossTest, EachDriveHasTheScaleThatItHasShown) {
  EXPECT_GT(Probability({}, 50, 50, 20.0), 1e3 * Probability({}, 50, 50));
}

TEST(SamePlaceTest, PassesOfAnotherDriveHaveItsScale) {
  const PoseGraph graph = TwoPasses(20.0, 1.0);
  RelativeModel scaled = IndependentModel();
  scaled.similarity.inflation = 5.0;
  EXPECT_EQ(SamePlaceProbability(graph, IndependentModel(), 50, 150, 0.0, 5.0),
            SamePlaceProbability(graph, scaled, 50, 150, 0.0));
}

}  // namespace
}  // namespace revisit::core
