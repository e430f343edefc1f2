#include "core/search/candidates/rivals.h"

#include <gtest/gtest.h>

#include "core/drive/frame_relation.h"
#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"

namespace revisit::core {
namespace {

// Three straight roads of 100 nodes each, 500 m from each other.
PoseGraph ThreeRoads() {
  PoseGraph graph;
  for (int i = 0; i < 300; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    node.pose = {2.0 * (i % 100), 500.0 * (i / 100), 0.0, 0.0};
    for (int k : {0, 1, 3}) node.covariance(k, k) = 1e-4;
    graph.AddNode(node, i % 100 == 0, std::nullopt);
  }
  return graph;
}

RankedPlace Claiming(NodeIndex node, double claimed,
                     Direction direction = Direction::kSame) {
  return {0, direction, {node, 0.0}, 0.0, claimed};
}

Rivals RivalsOf(const PoseGraph& graph,
                const std::vector<RankedPlace>& places) {
  RelativeModel model;
  model.similarity.correlation = CorrelationModel::kIndependent;
  return Rivals({{graph, graph.size()}}, nullptr, model, places);
}

TEST(RivalsTest, APlaceAloneHasWhatItClaims) {
  const Rivals rivals = RivalsOf(ThreeRoads(), {Claiming(50, 0.7)});
  EXPECT_EQ(rivals.Probability(0), 0.7);
  EXPECT_EQ(rivals.RunnerUp(0), 0.0);
}

TEST(RivalsTest, PlacesFarFromEachOtherShareNothing) {
  const Rivals rivals =
      RivalsOf(ThreeRoads(),
               {Claiming(50, 0.5), Claiming(150, 0.3), Claiming(250, 0.1)});
  EXPECT_NEAR(rivals.Probability(0), 0.5, 1e-9);
  EXPECT_NEAR(rivals.Probability(1), 0.3, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(0), 0.3, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(1), 0.5, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(2), 0.5, 1e-9);
}

TEST(RivalsTest, PassesOfOnePlaceSpeakForEachOther) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const Rivals rivals = RivalsOf(
      graph, {Claiming(50, 0.5), Claiming(150, 0.3), Claiming(250, 0.1)});
  EXPECT_NEAR(rivals.Probability(0), 0.8, 1e-9);
  EXPECT_NEAR(rivals.Probability(1), 0.8, 1e-9);
  EXPECT_NEAR(rivals.Probability(2), 0.1, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(0), 0.1, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(1), 0.1, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(2), 0.8, 1e-9);
}

TEST(RivalsTest, PassesOfTwoDrivesSpeakForEachOtherWhereALinkJoinsThem) {
  const PoseGraph asking = ThreeRoads();
  const PoseGraph other = ThreeRoads();
  const auto nodes_of = [](const PoseGraph& graph) {
    return FrameNodes{graph, StateSpace::kPlanar,
                      CorrelationModel::kIndependent};
  };
  FrameRelations frames;
  const NodeIndex last = asking.size() - 1;
  const std::size_t a = frames.AddDrive(nodes_of(asking), {}, last, {});
  const std::size_t b = frames.AddDrive(nodes_of(other), {}, last, {});
  frames.AddLink(b, a, {150, 50});
  std::vector<History> histories = {{asking, asking.size()},
                                    {other, other.size()}};
  histories[0].frame = a;
  histories[1].frame = b;
  std::vector<RankedPlace> places = {Claiming(50, 0.5), Claiming(150, 0.3),
                                     Claiming(250, 0.1)};
  places[1].history = 1;
  RelativeModel model;
  model.similarity.correlation = CorrelationModel::kIndependent;
  const Rivals rivals(histories, &frames, model, places);
  EXPECT_NEAR(rivals.Probability(0), 0.8, 1e-9);
  EXPECT_NEAR(rivals.Probability(1), 0.8, 1e-9);
  EXPECT_NEAR(rivals.Probability(2), 0.1, 1e-9);
}

TEST(RivalsTest, APlaceIsAsProbableAsItsPassesAreOnAverage) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const std::vector<History> histories = {{graph, graph.size()}};
  RelativeModel model;
  model.similarity.correlation = CorrelationModel::kIndependent;
  Rivals rivals(histories, nullptr, model,
                {Claiming(50, 0.5), Claiming(150, 0.3), Claiming(250, 0.1)});
  const double total = 0.5 / 2 + 0.3 / 2 + 0.1 + 0.1;
  EXPECT_NEAR(rivals.AverageOverPasses(histories, 0.1), 0.1 / total, 1e-9);
  EXPECT_NEAR(rivals.Probability(0), (0.5 / 2 + 0.3 / 2) / total, 1e-9);
  EXPECT_NEAR(rivals.Probability(1), (0.5 / 2 + 0.3 / 2) / total, 1e-9);
  EXPECT_NEAR(rivals.Probability(2), 0.1 / total, 1e-9);
  EXPECT_NEAR(rivals.RunnerUp(0), 0.1 / total, 1e-9);
}

// As on a road of which ends lie outside the stretches that were claimed.
TEST(RivalsTest, UnclaimedEndsHaveAsManyPassesAsClaimedOnesOnAverage) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const std::vector<History> histories = {{graph, graph.size()}};
  RelativeModel model;
  model.similarity.correlation = CorrelationModel::kIndependent;
  Rivals rivals(histories, nullptr, model,
                {Claiming(50, 0.4), Claiming(150, 0.2)});
  EXPECT_NEAR(rivals.AverageOverPasses(histories, 0.1), 0.1 / (0.1 + 0.9 / 2),
              1e-9);
  EXPECT_NEAR(rivals.Probability(0), 0.3 / (0.1 + 0.9 / 2), 1e-9);
}

TEST(RivalsTest, WithoutPlacesThereIsNothingToAverage) {
  const PoseGraph graph = ThreeRoads();
  const std::vector<History> histories = {{graph, graph.size()}};
  Rivals rivals(histories, nullptr, RelativeModel(), {});
  EXPECT_EQ(rivals.AverageOverPasses(histories, 0.7), 0.7);
}

TEST(RivalsTest, ProbabilitiesAreAtMostOne) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const Rivals rivals =
      RivalsOf(graph, {Claiming(50, 0.6), Claiming(150, 0.6)});
  EXPECT_EQ(rivals.Probability(0), 1.0);
}

TEST(RivalsTest, OnlyTheBestEndOfAStretchStandsForOtherPasses) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const Rivals rivals = RivalsOf(
      graph, {Claiming(50, 0.5), Claiming(59, 0.2), Claiming(150, 0.3)});
  EXPECT_NEAR(rivals.Probability(0), 0.8, 1e-9);
  EXPECT_EQ(rivals.Probability(1), 0.2);
}

TEST(RivalsTest, PassesInOppositeDirectionsAreTwoPlaces) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const Rivals rivals = RivalsOf(
      graph, {Claiming(50, 0.5), Claiming(150, 0.3, Direction::kOpposite)});
  EXPECT_EQ(rivals.Probability(0), 0.5);
  EXPECT_EQ(rivals.Probability(1), 0.3);
  EXPECT_EQ(rivals.RunnerUp(1), 0.5);
}

TEST(RivalsTest, AllPassesOfARoadSpeakForEachOtherHoweverManyThereAre) {
  // A road that was driven 200 times, and another once.
  PoseGraph graph;
  std::vector<RankedPlace> places;
  for (int i = 0; i < 201 * 20; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    node.pose = {2.0 * (i % 20), i / 20 == 200 ? 500.0 : 0.0, 0.0, 0.0};
    for (int k : {0, 1, 3}) node.covariance(k, k) = 1e-4;
    graph.AddNode(node, i % 20 == 0, std::nullopt);
  }
  for (int pass = 0; pass < 201; ++pass) {
    places.push_back(Claiming(pass * 20 + 10, pass == 200 ? 0.1 : 0.004));
  }
  const Rivals rivals = RivalsOf(graph, places);
  EXPECT_NEAR(rivals.Probability(0), 0.8, 0.01);
  EXPECT_NEAR(rivals.Probability(15), 0.8, 0.01);
  // Though none of the first is that one.
  EXPECT_NEAR(rivals.RunnerUp(0), 0.1, 1e-3);
}

TEST(RivalsTest, WhatIsImprobableIsNotAskedAbout) {
  PoseGraph graph = ThreeRoads();
  graph.AddLoopEdge(50, 150);
  const Rivals rivals =
      RivalsOf(graph, {Claiming(50, 0.5), Claiming(150, 0.0004)});
  EXPECT_EQ(rivals.Probability(0), 0.5);
  EXPECT_NEAR(rivals.Probability(1), 0.5004, 1e-9);
}

}  // namespace
}  // namespace revisit::core
