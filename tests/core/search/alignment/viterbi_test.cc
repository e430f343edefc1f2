#include "core/search/alignment/viterbi.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "tests/core/graphs.h"
#include "tests/oracle/path_enumeration.h"
#include "tests/oracle/plain_viterbi.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::ElementsAreArray;

// Score of a given path, straight from the definition in viterbi.h.
double PathScore(const PoseGraph& graph, const SimilarityModel& model,
                 NodeIndex query, NodeIndex size,
                 const std::vector<NodeIndex>& path) {
  double score = 0.0;
  const auto first = query - static_cast<NodeIndex>(path.size()) + 1;
  for (std::size_t t = 0; t < path.size(); ++t) {
    score +=
        LogSimilarity(graph, model, first + static_cast<NodeIndex>(t), path[t]);
    if (t + 1 < path.size()) {
      score -= std::log(
          static_cast<double>(oracle::Neighbours(graph, path[t], size).size()));
    }
  }
  return score;
}

std::string Describe(const PoseGraph& graph, NodeIndex query,
                     std::int64_t steps) {
  std::ostringstream text;
  text << graph.size() << " nodes, query " << query << ", " << steps
       << " steps, loops";
  for (const auto& [a, b] : graph.LoopEdges()) text << " " << a << "-" << b;
  text << ", segments start at";
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    if (graph.SegmentStart(i) == i) text << " " << i;
  }
  return text.str();
}

TEST(AlignTest, FindsWhatTryingAllPathsFinds) {
  std::mt19937_64 random = SeededRandom();
  int reachable = 0;
  for (int trial = 0; trial < 400; ++trial) {
    const NodeIndex size = UniformInt(random, 4, 12);
    const PoseGraph graph =
        RandomGraph(random, size, 0.15, UniformInt(random, 0, 3), trial % 2);
    const std::int64_t steps =
        UniformInt(random, 1, std::min(5, static_cast<int>(size) - 1));
    const NodeIndex query =
        UniformInt(random, static_cast<int>(steps), static_cast<int>(size) - 1);
    const NodeIndex history = query - steps + 1;
    SCOPED_TRACE(Describe(graph, query, steps));
    SimilarityModel model;
    model.state_space =
        trial % 3 == 0 ? StateSpace::kSpatial : StateSpace::kPlanar;
    model.correlation =
        trial % 2 ? CorrelationModel::kFilter : CorrelationModel::kIndependent;
    const auto alignment = Align(graph, model, query, steps, history, nullptr);
    ASSERT_TRUE(alignment);
    const auto expected =
        oracle::EnumeratePaths(graph, model, query, steps, history);
    for (NodeIndex j = 0; j < history; ++j) {
      const auto& best = expected[static_cast<std::size_t>(j)];
      if (best.score == kImpossible) {
        EXPECT_EQ(alignment->score(j), kImpossible) << j;
        continue;
      }
      ++reachable;
      EXPECT_NEAR(alignment->score(j), best.score, 1e-9 * std::abs(best.score))
          << j;
      const std::vector<NodeIndex> path = alignment->Path(j);
      EXPECT_THAT(path, ElementsAreArray(best.nodes));
      EXPECT_EQ(path.back(), j);
      EXPECT_NEAR(PathScore(graph, model, query, history, path), best.score,
                  1e-9 * std::abs(best.score));
    }
  }
  EXPECT_GT(reachable, 500);
}

TEST(AlignTest, StepsThroughManyBlocksAsItWouldThroughSingleNodes) {
  std::mt19937_64 random = SeededRandom();
  int reachable = 0;
  for (int trial = 0; trial < 120; ++trial) {
    const NodeIndex size = UniformInt(random, 100, 600);
    const PoseGraph graph =
        RandomGraph(random, size, trial % 4 == 0 ? 0.0 : 0.02,
                    UniformInt(random, 0, 30), trial % 3 == 0);
    const std::int64_t steps = UniformInt(random, 1, 30);
    const NodeIndex query =
        UniformInt(random, static_cast<int>(steps), static_cast<int>(size) - 1);
    const NodeIndex history = query - steps + 1;
    SCOPED_TRACE(Describe(graph, query, steps));
    SimilarityModel model;
    model.state_space =
        trial % 2 == 0 ? StateSpace::kSpatial : StateSpace::kPlanar;
    constexpr CorrelationModel kModels[] = {
        CorrelationModel::kFilter, CorrelationModel::kIndependent,
        CorrelationModel::kDeadReckoning, CorrelationModel::kCorrelatedFixes};
    model.correlation = {kModels[trial / 2 % 4], 20.0};
    const auto alignment = Align(graph, model, query, steps, history, nullptr);
    ASSERT_TRUE(alignment);
    const oracle::PlainViterbi expected =
        oracle::SolvePlainly(graph, model, query, steps, history);
    ASSERT_EQ(alignment->scores(), expected.scores.back());
    for (NodeIndex j = 0; j < history; j += 7) {
      if (alignment->score(j) == kImpossible) continue;
      ++reachable;
      ASSERT_EQ(alignment->Path(j), expected.Path(j)) << j;
    }
  }
  EXPECT_GT(reachable, 1000);
}

TEST(AlignTest, WalksLoopClosures) {
  // Two parallel stretches; the recent path begins like the end of the first
  // and goes on like the second. Only the loop closure joins the two.
  PoseGraph graph;
  const auto add = [&graph](double x, double y, bool starts) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(graph.size()) + 1;
    node.pose = {x, y, 0.0, 0.0};
    for (int i : {0, 1, 3}) node.covariance(i, i) = 0.01;
    graph.AddNode(node, starts, std::nullopt);
  };
  for (int i = 0; i < 4; ++i) add(10.0 * i, 0.0, i == 0);          // 0..3
  for (int i = 0; i < 4; ++i) add(500.0 + 10.0 * i, 0.0, i == 0);  // 4..7
  add(20.0, 0.0, true);  // 8: like node 2, 3, then 4, 5
  add(30.0, 0.0, false);
  add(500.0, 0.0, false);
  add(510.0, 0.0, false);
  SimilarityModel model;
  model.correlation = CorrelationModel::kIndependent;
  const auto best_end = [&](const Alignment& alignment) {
    NodeIndex best = 0;
    for (NodeIndex j = 1; j < alignment.size(); ++j) {
      if (alignment.score(j) > alignment.score(best)) best = j;
    }
    return best;
  };
  const auto without = Align(graph, model, 11, 4, 8, nullptr);
  EXPECT_LT(without->score(best_end(*without)), -1000.0);
  graph.AddLoopEdge(3, 4);
  const auto with = Align(graph, model, 11, 4, 8, nullptr);
  EXPECT_EQ(best_end(*with), 5);
  EXPECT_THAT(with->Path(5), ElementsAreArray({2, 3, 4, 5}));
  EXPECT_GT(with->score(5), -10.0);
}

TEST(AlignTest, StopsWhenTold) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 30, 0.0, 0, false);
  int asked = 0;
  const auto alignment = Align(graph, SimilarityModel{}, 29, 10, 20,
                               [&asked] { return ++asked == 3; });
  EXPECT_FALSE(alignment);
  EXPECT_EQ(asked, 3);
}

TEST(AlignTest, ASingleStepScoresPlainSimilarity) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 10, 0.0, 0, false);
  SimilarityModel model;
  model.correlation = CorrelationModel::kIndependent;
  const auto alignment = Align(graph, model, 9, 1, 9, nullptr);
  for (NodeIndex j = 0; j < 9; ++j) {
    EXPECT_DOUBLE_EQ(alignment->score(j), LogSimilarity(graph, model, 9, j));
    EXPECT_THAT(alignment->Path(j), ElementsAreArray({j}));
  }
}

}  // namespace
}  // namespace revisit::core
