#include "core/search/candidates/posterior.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <set>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/search/alignment/log_similarity.h"
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

std::array<ScoredEnds, 2> Possible(const LogOdds& log_odds) {
  return {PossibleEnds(log_odds[0]), PossibleEnds(log_odds[1])};
}

// All ends, the impossible ones among them.
std::array<ScoredEnds, 2> All(const LogOdds& log_odds) {
  std::array<ScoredEnds, 2> all;
  for (std::size_t way = 0; way < 2; ++way) {
    for (std::size_t k = 0; k < log_odds[way].size(); ++k) {
      all[way].push_back({static_cast<NodeIndex>(k), log_odds[way][k]});
    }
  }
  return all;
}

// Odds of the nodes near j that are not claimed yet, over the sum of all odds
// and 1.
long double ClaimLiterally(const PoseGraph& graph, const LogOdds& log_odds,
                           std::size_t direction, NodeIndex j,
                           std::set<std::pair<std::size_t, NodeIndex>>* taken) {
  long double all = 1.0L;
  long double here = 0.0L;
  for (std::size_t way = 0; way < 2; ++way) {
    for (std::size_t k = 0; k < log_odds[way].size(); ++k) {
      const auto i = static_cast<NodeIndex>(k);
      const long double odds =
          std::exp(static_cast<long double>(log_odds[way][k]));
      all += odds;
      if (way == direction &&
          std::abs(graph.node(i).travelled_meters -
                   graph.node(j).travelled_meters) <= kStretchRadiusMeters &&
          taken->insert({way, i}).second) {
        here += odds;
      }
    }
  }
  return here / all;
}

// The interval holds j and enough of what was claimed, and without its
// outermost nodes it would cut off more than it may on their side.
void ExpectInterval(const PoseGraph& graph, const std::vector<double>& log_odds,
                    std::size_t way, NodeIndex j,
                    const Posterior::Stretch& stretch,
                    const std::set<std::pair<std::size_t, NodeIndex>>& taken) {
  EXPECT_LE(stretch.first, j);
  EXPECT_GE(stretch.last, j);
  long double all = 0.0L;
  long double before = 0.0L;
  long double after = 0.0L;
  for (std::size_t k = 0; k < log_odds.size(); ++k) {
    const auto i = static_cast<NodeIndex>(k);
    if (graph.MetersApart(i, j) > kStretchRadiusMeters) continue;
    if (taken.count({way, i}) > 0) continue;
    const long double odds = std::exp(static_cast<long double>(log_odds[k]));
    all += odds;
    if (i < stretch.first) before += odds;
    if (i > stretch.last) after += odds;
  }
  const long double cut_off = 0.5L * (1.0L - kIntervalShare) * all;
  EXPECT_LE(before, cut_off * (1.0L + 1e-9L));
  EXPECT_LE(after, cut_off * (1.0L + 1e-9L));
}

TEST(PosteriorTest, IsOddsOverAllOdds) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const NodeIndex size = UniformInt(random, 1, 60);
    const PoseGraph graph = EvenGraph(size, Uniform(random, 0.5, 15.0));
    LogOdds log_odds;
    const int directions = UniformInt(random, 1, 3);
    long double all = 1.0L;
    for (std::size_t way = 0; way < 2; ++way) {
      if (!(directions & (1 << way))) continue;
      for (NodeIndex i = 0; i < size; ++i) {
        log_odds[way].push_back(UniformInt(random, 0, 9) == 0
                                    ? kImpossible
                                    : Uniform(random, -60.0, 60.0));
        all += std::exp(static_cast<long double>(log_odds[way].back()));
      }
    }
    Posterior posterior(
        {{graph, trial % 2 == 0 ? Possible(log_odds) : All(log_odds)}},
        kStretchRadiusMeters);
    const auto near = [](double actual, long double expected) {
      EXPECT_NEAR(actual, static_cast<double>(expected),
                  1e-12 * static_cast<double>(expected) + 1e-300);
    };
    near(posterior.new_place(), 1.0L / all);
    std::set<std::pair<std::size_t, NodeIndex>> taken;
    double sum = posterior.new_place();
    for (int claim = 0; claim < 100; ++claim) {
      const auto way = static_cast<std::size_t>(UniformInt(random, 0, 1));
      if (log_odds[way].empty()) continue;
      const NodeIndex j = UniformInt(random, 0, static_cast<int>(size) - 1);
      const auto before = taken;
      const Posterior::Stretch claimed = posterior.Claim(
          0, way == 0 ? Direction::kSame : Direction::kOpposite, j);
      near(claimed.probability,
           ClaimLiterally(graph, log_odds, way, j, &taken));
      ExpectInterval(graph, log_odds[way], way, j, claimed, before);
      sum += claimed.probability;
    }
    EXPECT_LE(sum, 1.0 + 1e-12);
    near(posterior.new_place(), 1.0L / all);
  }
}

TEST(PosteriorTest, SurvivesOddsBeyondDoubleRange) {
  const PoseGraph graph = EvenGraph(3, 100.0);
  Posterior posterior(
      {{graph, Possible({{{5000.0, 4999.0, kImpossible}, {}}})}},
      kStretchRadiusMeters);
  EXPECT_EQ(posterior.new_place(), 0.0);
  EXPECT_NEAR(posterior.Claim(0, Direction::kSame, 0).probability,
              1.0 / (1.0 + std::exp(-1.0)), 1e-12);
  EXPECT_EQ(posterior.Claim(0, Direction::kSame, 2).probability, 0.0);
}

TEST(PosteriorTest, WithoutAnyPossiblePlaceItIsNew) {
  const PoseGraph graph = EvenGraph(2, 2.0);
  Posterior posterior({{graph, All({{{kImpossible, kImpossible}, {}}})}},
                      kStretchRadiusMeters);
  EXPECT_EQ(posterior.new_place(), 1.0);
  EXPECT_EQ(posterior.Claim(0, Direction::kSame, 0).probability, 0.0);
}

}  // namespace
}  // namespace revisit::core
