#include "core/search/candidates/ranking.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/viterbi.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

std::int64_t Impossible(const ScoredEnds& ends) {
  return std::count_if(ends.begin(), ends.end(), [](const ScoredEnd& end) {
    return end.score == kImpossible;
  });
}

class RankingTest : public ::testing::Test {
 protected:
  // 60 nodes 2 m apart; one-step alignment, so that scores are plain
  // similarities.
  void Build(int seed_skip) {
    std::mt19937_64 random = SeededRandom();
    random.discard(static_cast<unsigned long long>(seed_skip));
    graph_ = RandomGraph(random, 60, 0.0, 0, false);
    SimilarityModel model;
    model.correlation = CorrelationModel::kIndependent;
    alignment_ = Align(graph_, model, 59, 1, 59, nullptr);
  }

  PoseGraph graph_;
  std::optional<Alignment> alignment_;
};

TEST_F(RankingTest, TakesTheBestThatAreFarEnoughApart) {
  for (int trial = 0; trial < 20; ++trial) {
    Build(1000 * trial);
    for (double separation : {0.0, 3.0, 10.0, 50.0}) {
      ScoredEnds scores = PossibleEnds(alignment_->scores());
      StrikeOut(NodesNearer(graph_, 59, separation), &scores);
      const auto ends = RankEnds(graph_, scores, separation, 8);
      // The obvious way: sort all ends and take each that is far from those
      // taken before.
      std::vector<NodeIndex> order(59);
      for (NodeIndex i = 0; i < 59; ++i) order[static_cast<std::size_t>(i)] = i;
      std::sort(order.begin(), order.end(), [&](NodeIndex a, NodeIndex b) {
        const double sa = alignment_->score(a);
        const double sb = alignment_->score(b);
        return sa != sb ? sa > sb : a < b;
      });
      std::vector<NodeIndex> taken;
      for (NodeIndex i : order) {
        const auto far_from = [&](NodeIndex j) {
          return i != j &&
                 std::abs(graph_.node(i).travelled_meters -
                          graph_.node(j).travelled_meters) >= separation;
        };
        if (taken.size() < 8 && far_from(59) &&
            std::all_of(taken.begin(), taken.end(), far_from)) {
          taken.push_back(i);
        }
      }
      ASSERT_EQ(ends.size(), taken.size());
      for (std::size_t k = 0; k < ends.size(); ++k) {
        EXPECT_EQ(ends[k].matched, taken[k]);
        EXPECT_EQ(ends[k].score, alignment_->score(taken[k]));
      }
    }
  }
}

TEST_F(RankingTest, OfEqualScoresTheOlderNodeComesFirst) {
  PoseGraph graph;
  for (int i = 0; i < 10; ++i) {
    Node node;
    node.travelled_meters = 2.0 * i;
    for (int k : {0, 1, 3}) node.covariance(k, k) = 1.0;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  SimilarityModel model;
  model.correlation = CorrelationModel::kIndependent;
  const auto alignment = Align(graph, model, 9, 1, 9, nullptr);
  ScoredEnds scores = PossibleEnds(alignment->scores());
  StrikeOut(NodesNearer(graph, 9, 4.0), &scores);
  const auto ends = RankEnds(graph, scores, 4.0, 100);
  ASSERT_EQ(ends.size(), 4u);
  EXPECT_EQ(ends[0].matched, 0);
  EXPECT_EQ(ends[1].matched, 2);
  EXPECT_EQ(ends[2].matched, 4);
  EXPECT_EQ(ends[3].matched, 6);
}

TEST_F(RankingTest, StrikesOutTheCentreAndWhatIsNearer) {
  Build(0);
  const std::vector<double> alike(59, 1.0);
  ScoredEnds ends = PossibleEnds(alike);
  StrikeOut(NodesNearer(graph_, 30, 4.0), &ends);
  for (NodeIndex i = 0; i < 59; ++i) {
    EXPECT_EQ(ends[static_cast<std::size_t>(i)].score,
              i >= 29 && i <= 31 ? kImpossible : 1.0)
        << i;
  }
  ends = PossibleEnds(alike);
  StrikeOut(NodesNearer(graph_, 30, 0.0), &ends);
  EXPECT_EQ(Impossible(ends), 1);
  EXPECT_EQ(ends[30].score, kImpossible);
  // Fewer ends than nodes.
  ends = PossibleEnds(std::vector<double>(20, 1.0));
  StrikeOut(NodesNearer(graph_, 22, 10.0), &ends);
  EXPECT_EQ(Impossible(ends), 2);
  StrikeOut(NodesNearer(graph_, 59, 10.0), &ends);
  EXPECT_EQ(Impossible(ends), 2);
}

TEST_F(RankingTest, StrikesOutWhatIsThereAroundACentreThatIsNot) {
  Build(0);
  ScoredEnds ends = {{3, 1.0}, {10, 1.0}, {14, 1.0}, {15, 1.0}, {40, 1.0}};
  StrikeOut(NodesNearer(graph_, 12, 6.0), &ends);
  EXPECT_EQ(Impossible(ends), 2);
  EXPECT_EQ(ends[1].score, kImpossible);
  EXPECT_EQ(ends[2].score, kImpossible);
  StrikeOut(NodesNearer(graph_, 25, 2.0), &ends);
  EXPECT_EQ(Impossible(ends), 2);
  ends.clear();
  StrikeOut(NodesNearer(graph_, 12, 6.0), &ends);
  EXPECT_TRUE(ends.empty());
}

TEST_F(RankingTest, OfManyEndsTakesThoseThatLookingThroughAllAgainTakes) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    PoseGraph graph;
    Node node;
    const NodeIndex size = UniformInt(random, 1, 1500);
    for (NodeIndex i = 0; i < size; ++i) {
      graph.AddNode(node, i == 0, std::nullopt);
      // Sometimes two nodes at one place.
      node.travelled_meters +=
          UniformInt(random, 0, 9) == 0 ? 0.0 : Uniform(random, 1.0, 3.0);
    }
    ScoredEnds ends;
    const double share = Uniform(random, 0.0, 1.0);
    // Few different scores, so that many are equal, or all different.
    const int scores = UniformInt(random, 0, 1) == 0 ? 10 : 1 << 30;
    for (NodeIndex i = 0; i < size; ++i) {
      if (Uniform(random, 0.0, 1.0) > share) continue;
      const int score = UniformInt(random, 0, scores);
      ends.push_back({i, score == 0 ? kImpossible : score});
    }
    const double separation = Uniform(random, 0.0, 1.0) < 0.1
                                  ? 0.0
                                  : std::exp(Uniform(random, 0.0, 7.0));
    const int most = UniformInt(random, 0, 40);
    const std::vector<RankedEnd> ranked =
        RankEnds(graph, ends, separation, most);
    ScoredEnds left = ends;
    for (const RankedEnd& end : ranked) {
      const auto best = std::max_element(
          left.begin(), left.end(), [](const ScoredEnd& a, const ScoredEnd& b) {
            return a.score < b.score;
          });
      ASSERT_NE(best, left.end());
      ASSERT_NE(best->score, kImpossible);
      EXPECT_EQ(end.matched, best->node);
      EXPECT_EQ(end.score, best->score);
      for (ScoredEnd& other : left) {
        if (other.node == end.matched ||
            graph.MetersApart(other.node, end.matched) < separation) {
          other.score = kImpossible;
        }
      }
    }
    if (ranked.size() < static_cast<std::size_t>(most)) {
      EXPECT_EQ(Impossible(left), static_cast<std::int64_t>(left.size()));
    } else {
      EXPECT_EQ(ranked.size(), static_cast<std::size_t>(most));
    }
  }
}

}  // namespace
}  // namespace revisit::core
