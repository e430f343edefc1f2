#include "core/candidates/posterior.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

PoseGraph EvenGraph(NodeIndex size, double spacing) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.travelled_meters = spacing * static_cast<double>(i);
    graph.AddNode(node, i == 0, std::nullopt);
  }
  return graph;
}

using LogOdds = std::array<std::vector<double>, 2>;

// Odds over the sum of all odds and 1.
long double Literal(const PoseGraph& graph, const LogOdds& log_odds,
                    std::size_t direction, NodeIndex j) {
  long double all = 1.0L;
  long double here = 0.0L;
  for (std::size_t way = 0; way < 2; ++way) {
    for (std::size_t i = 0; i < log_odds[way].size(); ++i) {
      const long double odds =
          std::exp(static_cast<long double>(log_odds[way][i]));
      all += odds;
      if (way == direction &&
          std::abs(graph.node(static_cast<NodeIndex>(i)).travelled_meters -
                   graph.node(j).travelled_meters) <= kPlaceRadiusMeters) {
        here += odds;
      }
    }
  }
  return here / all;
}

TEST(PosteriorTest, IsOddsOverAllOdds) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const NodeIndex size = UniformInt(random, 1, 60);
    const PoseGraph graph = EvenGraph(size, Uniform(random, 0.5, 15.0));
    LogOdds log_odds;
    const int directions = UniformInt(random, 1, 3);
    for (std::size_t way = 0; way < 2; ++way) {
      if (!(directions & (1 << way))) continue;
      for (NodeIndex i = 0; i < size; ++i) {
        log_odds[way].push_back(UniformInt(random, 0, 9) == 0
                                    ? kImpossible
                                    : Uniform(random, -60.0, 60.0));
      }
    }
    const Posterior posterior(graph, log_odds);
    long double all = 1.0L;
    for (const auto& odds : log_odds) {
      for (const double o : odds) all += std::exp(static_cast<long double>(o));
    }
    const auto near = [](double actual, long double expected) {
      EXPECT_NEAR(actual, static_cast<double>(expected),
                  1e-12 * static_cast<double>(expected) + 1e-300);
    };
    near(posterior.new_place(), 1.0L / all);
    for (std::size_t way = 0; way < 2; ++way) {
      for (NodeIndex j = 0; j < static_cast<NodeIndex>(log_odds[way].size());
           ++j) {
        near(posterior.Place(way == 0 ? Direction::kSame : Direction::kOpposite,
                             j),
             std::min(1.0L, Literal(graph, log_odds, way, j)));
      }
    }
  }
}

TEST(PosteriorTest, SurvivesOddsBeyondDoubleRange) {
  const PoseGraph graph = EvenGraph(3, 100.0);
  const LogOdds log_odds = {{{5000.0, 4999.0, kImpossible}, {}}};
  const Posterior posterior(graph, log_odds);
  EXPECT_EQ(posterior.new_place(), 0.0);
  EXPECT_NEAR(posterior.Place(Direction::kSame, 0),
              1.0 / (1.0 + std::exp(-1.0)), 1e-12);
  EXPECT_EQ(posterior.Place(Direction::kSame, 2), 0.0);
}

TEST(PosteriorTest, WithoutAnyPossiblePlaceItIsNew) {
  const PoseGraph graph = EvenGraph(2, 2.0);
  const LogOdds log_odds = {{{kImpossible, kImpossible}, {}}};
  const Posterior posterior(graph, log_odds);
  EXPECT_EQ(posterior.new_place(), 1.0);
  EXPECT_EQ(posterior.Place(Direction::kSame, 0), 0.0);
}

}  // namespace
}  // namespace revisit::core
