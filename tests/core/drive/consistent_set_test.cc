#include "core/drive/consistent_set.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <boost/graph/adjacency_matrix.hpp>
#include <boost/graph/bron_kerbosch_all_cliques.hpp>
#include <cstddef>
#include <iostream>
#include <random>
#include <vector>

#include "tests/random.h"

namespace revisit::core {
namespace {

// Pairs agree at random; some sets of vertices agree whole.
ConsistencyGraph RandomAgreement(std::mt19937_64& random, int size,
                                 double share, int agreeing) {
  ConsistencyGraph graph(static_cast<std::size_t>(size));
  std::vector<int> set(static_cast<std::size_t>(size));
  for (int& vertex : set) vertex = UniformInt(random, 0, 2 * size);
  for (int i = 0; i < size; ++i) {
    for (int j = 0; j < i; ++j) {
      const bool together = set[static_cast<std::size_t>(i)] < agreeing &&
                            set[static_cast<std::size_t>(j)] < agreeing;
      if (together || Uniform(random, 0.0, 1.0) < share) {
        graph.SetAgree(static_cast<std::size_t>(i), static_cast<std::size_t>(j),
                       true);
      }
    }
  }
  return graph;
}

bool IsConsistent(const ConsistencyGraph& graph,
                  const std::vector<std::size_t>& members) {
  for (const std::size_t i : members) {
    for (const std::size_t j : members) {
      if (i != j && !graph.Agree(i, j)) return false;
    }
  }
  return std::is_sorted(members.begin(), members.end());
}

// The size of the largest clique among all of them.
struct Largest {
  template <typename Clique, typename Graph>
  void clique(const Clique& clique, const Graph& /*graph*/) {
    *size = std::max(*size, clique.size());
  }
  std::size_t* size;
};

std::size_t SizeByAllCliques(const ConsistencyGraph& graph) {
  boost::adjacency_matrix<boost::undirectedS> boosted(graph.size());
  for (std::size_t i = 0; i < graph.size(); ++i) {
    for (std::size_t j = 0; j < i; ++j) {
      if (graph.Agree(i, j)) boost::add_edge(i, j, boosted);
    }
  }
  std::size_t size = 0;
  boost::bron_kerbosch_all_cliques(boosted, Largest{&size}, 1);
  return size;
}

TEST(ConsistentSetTest, IsAsLargeAsTheLargestOfAllCliques) {
  std::mt19937_64 random = SeededRandom();
  std::size_t greatest = 0;
  for (int trial = 0; trial < 1500; ++trial) {
    const int size = UniformInt(random, 1, trial % 10 == 0 ? 80 : 30);
    const double share =
        size > 40 ? Uniform(random, 0.0, 0.6) : Uniform(random, 0.0, 1.0);
    const ConsistencyGraph graph =
        RandomAgreement(random, size, share, UniformInt(random, 0, size));
    const ConsistentSet set = LargestConsistentSet(graph);
    ASSERT_FALSE(set.approximate) << trial;
    ASSERT_TRUE(IsConsistent(graph, set.members)) << trial;
    ASSERT_EQ(set.members.size(), SizeByAllCliques(graph)) << trial;
    greatest = std::max(greatest, set.members.size());
  }
  std::cout << "up to " << greatest << " members\n";
  EXPECT_GT(greatest, 20u);
}

TEST(ConsistentSetTest, StoppingChangesNothing) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 30; ++trial) {
    const ConsistencyGraph graph =
        RandomAgreement(random, 120, Uniform(random, 0.3, 0.8), 100);
    const ConsistentSet wanted = LargestConsistentSet(graph, 5000);
    ConsistentSetSearch search(graph, 5000);
    int asked = 0;
    int stopped = 0;
    const auto now_and_then = [&] { return ++asked % 3 == 0; };
    while (!search.Run(now_and_then)) ++stopped;
    EXPECT_EQ(search.best().members, wanted.members);
    EXPECT_EQ(search.best().approximate, wanted.approximate);
    EXPECT_TRUE(!wanted.approximate || stopped > 10) << stopped;
  }
}

TEST(ConsistentSetTest, WhereStepsEndTheBestSoFarIsAnsweredAndSaysSo) {
  std::mt19937_64 random = SeededRandom();
  const ConsistencyGraph graph = RandomAgreement(random, 200, 0.9, 20);
  const ConsistentSet first = LargestConsistentSet(graph, 0);
  const ConsistentSet later = LargestConsistentSet(graph, 20'000);
  for (const ConsistentSet& set : {first, later}) {
    EXPECT_TRUE(set.approximate);
    EXPECT_TRUE(IsConsistent(graph, set.members));
  }
  EXPECT_GT(later.members.size(), first.members.size());
}

TEST(ConsistentSetTest, OfSetsAsLargeThatInTheOrderOfVerticesIsTaken) {
  ConsistencyGraph graph(6);
  for (const auto& [i, j] : {std::pair(0, 3), {1, 4}, {2, 5}}) {
    graph.SetAgree(static_cast<std::size_t>(i), static_cast<std::size_t>(j),
                   true);
  }
  EXPECT_EQ(LargestConsistentSet(graph).members,
            (std::vector<std::size_t>{0, 3}));
}

TEST(ConsistentSetTest, SmallAndWholeGraphsAreTheirOwnSets) {
  EXPECT_TRUE(LargestConsistentSet(ConsistencyGraph(0)).members.empty());
  EXPECT_EQ(LargestConsistentSet(ConsistencyGraph(3)).members,
            (std::vector<std::size_t>{0}));
  for (const std::size_t size : {1u, 63u, 64u, 65u, 1000u}) {
    const ConsistentSet set =
        LargestConsistentSet(ConsistencyGraph(size, /*agreeing=*/true));
    EXPECT_EQ(set.members.size(), size);
    EXPECT_FALSE(set.approximate);
  }
}

}  // namespace
}  // namespace revisit::core
