#include "core/search/alignment/relative.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <ostream>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/search/alignment/log_similarity.h"
#include "tests/core/graphs.h"
#include "tests/core/search/alignment/towns.h"
#include "tests/oracle/survivor_lists.h"
#include "tests/random.h"

namespace revisit::core {

void PrintTo(const PathStep& step, std::ostream* out) {
  *out << step.t << ": " << step.node
       << (step.direction == Direction::kSame ? "" : " opposite");
}

namespace {

using ::testing::ElementsAre;

// How often each case has occurred in the trials.
struct Seen {
  int ends = 0;
  int walked = 0;
  int slipped = 0;
  int over_loops = 0;
  int turned_over_loops = 0;
  int opposite = 0;
  int impossible = 0;
  int straight_across = 0;
  int met = 0;
  int beyond_most = 0;
};

void ExpectWhatListsFind(const Town& town, Seen* seen) {
  SCOPED_TRACE(town.Text());
  const auto alignment =
      AlignRelative(town.Asked(), town.Past(), town.model, nullptr);
  ASSERT_TRUE(alignment);
  oracle::SurvivorLists lists(town.Asked(), town.Past(), town.model);
  seen->met += lists.met();
  seen->beyond_most += lists.beyond_most();
  for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
    const ScoredEnds& ends = alignment->ends(direction);
    auto end = ends.begin();
    const auto& expected = lists.matches()[IndexOf(direction)];
    for (std::size_t k = 0; k < expected.size(); ++k) {
      const NodeIndex j = town.first + static_cast<NodeIndex>(k);
      SCOPED_TRACE(::testing::Message()
                   << "way " << IndexOf(direction) << " end " << j);
      const auto& match = expected[k];
      const bool found = end != ends.end() && end->node == j;
      ASSERT_EQ(found, match.possible);
      if (!found) {
        ++seen->impossible;
        continue;
      }
      const auto near = [](double actual, oracle::Wide wanted) {
        const auto value = static_cast<double>(wanted);
        EXPECT_NEAR(actual, value, 1e-9 * std::max(1.0, std::abs(value)));
      };
      seen->straight_across += match.is_straight_across;
      if (!match.is_straight_across) near(end->score, match.score);
      ++end;
      const ShapeMatch& actual = alignment->match(direction, j);
      near(actual.log_likelihood_ratio, match.log_likelihood_ratio);
      near(actual.squared_innovations, match.squared_innovations);
      if (!match.is_straight_across) {
        near(actual.squared_end_difference, match.squared_end_difference);
      }
      EXPECT_EQ(actual.steps + 1,
                static_cast<std::int64_t>(match.entries.size()));
      std::vector<PathStep> path;
      int before = match.entries.front().way;
      for (const oracle::PathEntry& entry : match.entries) {
        path.push_back(
            {entry.t, entry.node,
             entry.way == 0 ? Direction::kSame : Direction::kOpposite});
        seen->slipped += entry.slipped;
        seen->over_loops += entry.over.has_value();
        seen->turned_over_loops += entry.way != before;
        before = entry.way;
      }
      EXPECT_EQ(alignment->Path(direction, j), path);
      ++seen->ends;
      seen->walked += actual.steps > 0;
      seen->opposite += direction == Direction::kOpposite && actual.steps > 0;
    }
    EXPECT_EQ(end, ends.end());
  }
  EXPECT_EQ(alignment->considered(), town.history - town.first);
}

TEST(AlignRelativeTest, FindsWhatASearchWithWholePathsFinds) {
  std::mt19937_64 random = SeededRandom();
  Seen seen;
  for (int trial = 0; trial < 200 && !::testing::Test::HasFailure(); ++trial) {
    ExpectWhatListsFind(RandomTown(random), &seen);
  }
  std::cout << seen.ends << " ends, " << seen.walked << " with a path, "
            << seen.opposite << " of them opposite; steps that slipped "
            << seen.slipped << ", over loop closures " << seen.over_loops
            << ", of these between directions " << seen.turned_over_loops
            << "; impossible " << seen.impossible << "\n";
  EXPECT_GT(seen.walked, 500);
  EXPECT_GT(seen.slipped, 0);
  EXPECT_GT(seen.over_loops, 50);
  EXPECT_GT(seen.turned_over_loops, 10);
  EXPECT_GT(seen.opposite, 100);
}

// A town of short passes in which a path that can become no better than it was
// stays at the first node, and ends a path that would have become better there.
// One random town in some ten thousand has that.
TEST(AlignRelativeTest, APathOfNoFurtherUseStillEndsTheLessLikelyThatMeetIt) {
  std::mt19937_64 random(5745);
  Seen seen;
  ExpectWhatListsFind(RandomTown(random), &seen);
  EXPECT_GT(seen.met, 0);
}

TEST(AlignRelativeTest, FindsInAnotherFrameWhatASearchWithWholePathsFinds) {
  std::mt19937_64 random = SeededRandom();
  Seen seen;
  int drifts = 0;
  int unknown = 0;
  for (int trial = 0; trial < 300 && !::testing::Test::HasFailure(); ++trial) {
    Town town = RandomTown(random);
    if (!MoveApart(random, &town)) continue;
    drifts += static_cast<int>(town.relation.drifts().size());
    unknown += town.relation.tie().is_tied() ? 0 : 1;
    ExpectWhatListsFind(town, &seen);
  }
  std::cout << seen.ends << " ends, " << seen.walked << " with a path, "
            << seen.opposite << " of them opposite; steps over loop closures "
            << seen.over_loops << "; impossible " << seen.impossible
            << "; drifts " << drifts << "; untied " << unknown
            << "; straight across " << seen.straight_across << "\n";
  EXPECT_GT(seen.walked, 500);
  EXPECT_GT(seen.over_loops, 20);
  EXPECT_GT(seen.opposite, 100);
  EXPECT_GT(drifts, 30);
  EXPECT_GT(unknown, 20);
  EXPECT_LT(seen.straight_across, seen.ends / 100);
}

TEST(AlignRelativeTest,
     FindsTheSameWhereCovariancesHaveNothingToDoWithThePath) {
  std::mt19937_64 random = SeededRandom();
  Seen seen;
  for (int trial = 0; trial < 40 && !::testing::Test::HasFailure(); ++trial) {
    Town town;
    const NodeIndex size = UniformInt(random, 4, 16);
    town.graph = RandomGraph(random, size, 0.1, UniformInt(random, 0, 4), true);
    constexpr CorrelationModel kModels[] = {CorrelationModel::kFilter,
                                            CorrelationModel::kIndependent,
                                            CorrelationModel::kCorrelatedFixes};
    town.model.similarity.correlation = {kModels[trial % 3],
                                         Uniform(random, 1.0, 50.0)};
    town.model.opposite_direction = true;
    town.model.shape.tolerance = {3.0, 0.5};
    town.query = size - 1;
    town.steps = UniformInt(
        random, 1,
        static_cast<int>(std::min<NodeIndex>(
            4, town.query - town.graph.SegmentStart(town.query) + 1)));
    town.history = town.query - town.steps + 1;
    ExpectWhatListsFind(town, &seen);
  }
  EXPECT_GT(seen.ends, 200);
}

void ExpectTheSame(const RelativeAlignment& a, const RelativeAlignment& b) {
  EXPECT_EQ(a.considered(), b.considered());
  for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
    const ScoredEnds& ends = a.ends(direction);
    ASSERT_EQ(ends.size(), b.ends(direction).size());
    for (std::size_t i = 0; i < ends.size(); ++i) {
      const ScoredEnd& other = b.ends(direction)[i];
      ASSERT_EQ(ends[i].node, other.node);
      EXPECT_EQ(ends[i].score, other.score);
      EXPECT_EQ(a.match(direction, ends[i].node).squared_end_difference,
                b.match(direction, ends[i].node).squared_end_difference);
      EXPECT_EQ(a.Path(direction, ends[i].node),
                b.Path(direction, ends[i].node));
    }
  }
}

// More nodes, and other loop closures.
PoseGraph DrivenOn(const Town& town) {
  PoseGraph graph = town.graph;
  for (const auto& [a, b] : town.graph.LoopEdges()) graph.RemoveLoopEdge(a, b);
  for (NodeIndex i = 0; i < 200; ++i) {
    Node node = graph.node(i);
    const Node last = graph.node(graph.size() - 1);
    node.sequence = last.sequence + 1;
    node.travelled_meters = last.travelled_meters + town.model.spacing_meters;
    graph.AddNode(node, i == 0, graph.transition(i));
  }
  graph.AddLoopEdge(0, town.history - 1);
  graph.AddLoopEdge(town.query, graph.size() - 1);
  return graph;
}

TEST(AlignRelativeTest, ACopyOfTheGraphAnswersAsTheGraphDidThen) {
  std::mt19937_64 random = SeededRandom();
  int of_other_loops = 0;
  for (int trial = 0; trial < 200; ++trial) {
    const Town town = RandomTown(random, 4);
    SCOPED_TRACE(town.Text());
    const auto then =
        AlignRelative(town.Asked(), town.Past(), town.model, nullptr);
    const PoseGraph now = DrivenOn(town);
    const Query query{now, town.query, town.steps};
    const auto again = AlignRelative(query, town.Past(), town.model, nullptr);
    ASSERT_TRUE(then && again);
    ExpectTheSame(*again, *then);
    // With the drive as it is now, paths are walked over other closures.
    const auto anew =
        AlignRelative(query, {now, town.history}, town.model, nullptr);
    for (const ScoredEnd& end : anew->ends(Direction::kSame)) {
      of_other_loops += anew->Path(Direction::kSame, end.node) !=
                        then->Path(Direction::kSame, end.node);
    }
  }
  EXPECT_GT(of_other_loops, 100);
}

// A winding road as nodes without drift, each pass a segment of its own.
class WindingRoadTest : public ::testing::Test {
 protected:
  // Adds the nodes at these metres along the road; returns the first.
  NodeIndex Add(double from, double to, double stride = 2.0) {
    return Add(from, to, stride, true);
  }

  // The same, as part of the segment before.
  void Append(double from, double to) { Add(from, to, 2.0, false); }

  NodeIndex Add(double from, double to, double stride, bool starts_segment) {
    const NodeIndex first = graph_.size();
    const double sign = to < from ? -1.0 : 1.0;
    const auto nodes = std::llround(std::abs(to - from) / stride);
    for (std::int64_t k = 0; k <= nodes; ++k) {
      const double along = from + sign * stride * static_cast<double>(k);
      Node node;
      node.sequence = static_cast<std::uint64_t>(graph_.size()) + 1;
      node.travelled_meters = 2.0 * static_cast<double>(graph_.size());
      node.pose = RoadAt(along);
      if (sign < 0.0) node.pose.heading = WrapHeading(node.pose.heading + kPi);
      for (int i : {0, 1, 2}) node.covariance(i, i) = sigma_ * sigma_;
      node.covariance(3, 3) = 0.01 * sigma_ * sigma_;
      graph_.AddNode(node, k == 0 && starts_segment, std::nullopt);
    }
    return first;
  }

  static Pose RoadAt(double along) {
    // Curvature 0.03 sin(along / 17) + 0.02 sin(along / 7.3), summed finely.
    Pose pose;
    const double step = 0.05;
    for (double s = 0.5 * step; s < along; s += step) {
      pose.heading +=
          step * (0.03 * std::sin(s / 17.0) + 0.02 * std::sin(s / 7.3));
      pose.x += step * std::cos(pose.heading);
      pose.y += step * std::sin(pose.heading);
    }
    pose.heading = WrapHeading(pose.heading);
    return pose;
  }

  // Aligns the nodes from `first` to the newest, with those before as history.
  RelativeAlignment Align(NodeIndex first) {
    model_.similarity.correlation = CorrelationModel::kIndependent;
    const NodeIndex query = graph_.size() - 1;
    return *AlignRelative({graph_, query, query - first + 1}, {graph_, first},
                          model_, nullptr);
  }

  // The node of the best end.
  static NodeIndex Best(const RelativeAlignment& alignment,
                        Direction direction) {
    return std::max_element(alignment.ends(direction).begin(),
                            alignment.ends(direction).end(),
                            [](const ScoredEnd& a, const ScoredEnd& b) {
                              return a.score < b.score;
                            })
        ->node;
  }

  static double ScoreOf(const RelativeAlignment& alignment, Direction direction,
                        NodeIndex j) {
    for (const ScoredEnd& end : alignment.ends(direction)) {
      if (end.node == j) return end.score;
    }
    return kImpossible;
  }

  static int Slips(const std::vector<PathStep>& path) {
    int slips = 0;
    for (std::size_t k = 1; k < path.size(); ++k) {
      slips += path[k - 1].node - path[k].node != 1;
    }
    return slips;
  }

  // Standard deviation of each node's position, m.
  double sigma_ = 1.0;
  PoseGraph graph_;
  RelativeModel model_;
};

TEST_F(WindingRoadTest, ARevisitIsWalkedBackNodeByNode) {
  Add(0.0, 300.0);
  const NodeIndex recent = Add(100.0, 200.0);
  const RelativeAlignment alignment = Align(recent);
  const ShapeMatch& match = alignment.match(Direction::kSame, 100);
  EXPECT_EQ(match.steps, 50);
  EXPECT_NEAR(match.squared_innovations, 0.0, 1e-9);
  const auto path = alignment.Path(Direction::kSame, 100);
  ASSERT_EQ(path.size(), 51u);
  for (std::int64_t t = 0; t <= 50; ++t) {
    EXPECT_EQ(path[static_cast<std::size_t>(t)],
              (PathStep{t, 100 - t, Direction::kSame}));
  }
  EXPECT_EQ(Best(alignment, Direction::kSame), 100);
  EXPECT_TRUE(alignment.ends(Direction::kOpposite).empty());
}

TEST_F(WindingRoadTest, ARevisitTheOtherWayIsWalkedForward) {
  Add(0.0, 300.0);
  const NodeIndex recent = Add(200.0, 100.0);
  model_.opposite_direction = true;
  const RelativeAlignment alignment = Align(recent);
  // The end is at 100 m, node 50; the path began at node 100.
  const ShapeMatch& match = alignment.match(Direction::kOpposite, 50);
  EXPECT_EQ(match.steps, 50);
  EXPECT_NEAR(match.squared_innovations, 0.0, 1e-9);
  const auto path = alignment.Path(Direction::kOpposite, 50);
  EXPECT_EQ(path.front(), (PathStep{0, 50, Direction::kOpposite}));
  EXPECT_EQ(path.back(), (PathStep{50, 100, Direction::kOpposite}));
  EXPECT_EQ(Best(alignment, Direction::kOpposite), 50);
  const NodeIndex best_same = Best(alignment, Direction::kSame);
  EXPECT_GT(ScoreOf(alignment, Direction::kOpposite, 50),
            ScoreOf(alignment, Direction::kSame, best_same) + 10.0);
}

TEST_F(WindingRoadTest, OnlyTheOverlapIsTakenWhereTheOldRoadWasJoinedLate) {
  // The history begins at 140 m, the recent path comes from before.
  Add(140.0, 300.0);
  const NodeIndex recent = Add(80.0, 200.0);
  const RelativeAlignment alignment = Align(recent);
  const ShapeMatch& match = alignment.match(Direction::kSame, 30);
  // 60 m of 120, apart from a slip or two at the end.
  EXPECT_GE(match.steps, 30);
  EXPECT_LE(match.steps, 33);
  EXPECT_GT(match.log_likelihood_ratio, 5.0);
}

TEST_F(WindingRoadTest, TheOverlapGoesOnOverALoopClosure) {
  // The history saw the road in two passes; a closure joins them at 150 m.
  Add(0.0, 160.0);                             // Nodes 0..80.
  const NodeIndex second = Add(140.0, 300.0);  // Nodes 81..161.
  ASSERT_EQ(second, 81);
  const NodeIndex recent = Add(100.0, 200.0);
  const NodeIndex end = second + 30;
  EXPECT_LT(Align(recent).match(Direction::kSame, end).steps, 34);
  graph_.AddLoopEdge(second + 5, 75);
  const RelativeAlignment alignment = Align(recent);
  const ShapeMatch& match = alignment.match(Direction::kSame, end);
  EXPECT_EQ(match.steps, 50);
  EXPECT_NEAR(match.squared_innovations, 0.0, 1e-9);
  const auto path = alignment.Path(Direction::kSame, end);
  ASSERT_EQ(path.size(), 51u);
  EXPECT_EQ(path[25].node, second + 5);
  EXPECT_EQ(path[26].node, 74);
  EXPECT_EQ(path[50], (PathStep{50, 50, Direction::kSame}));
}

TEST_F(WindingRoadTest, TheOverlapGoesOnOverALoopClosureOfOppositePasses) {
  Add(160.0, 0.0);                             // Nodes 0..80, the other way.
  const NodeIndex second = Add(140.0, 300.0);  // Nodes 81..161.
  const NodeIndex recent = Add(100.0, 200.0);
  graph_.AddLoopEdge(second + 5, 5);  // Both at 150 m.
  const RelativeAlignment alignment = Align(recent);
  const ShapeMatch& match = alignment.match(Direction::kSame, second + 30);
  EXPECT_EQ(match.steps, 50);
  // At 100 m.
  EXPECT_EQ(alignment.Path(Direction::kSame, second + 30).back(),
            (PathStep{50, 30, Direction::kOpposite}));
  EXPECT_NEAR(match.squared_innovations, 0.0, 1e-9);
}

TEST_F(WindingRoadTest, AnOdometerThatIsThreePercentOffHidesNoneOfTheOverlap) {
  for (const double stride : {2.0 / 1.03, 2.0 * 1.03}) {
    graph_ = PoseGraph();
    Add(0.0, 400.0);
    const NodeIndex recent = Add(100.0, 100.0 + 74.0 * stride, stride);
    ASSERT_EQ(graph_.size() - recent, 75);
    const RelativeAlignment alignment = Align(recent);
    const NodeIndex best = Best(alignment, Direction::kSame);
    EXPECT_NEAR(2.0 * static_cast<double>(best), 100.0 + 74.0 * stride, 4.0);
    EXPECT_EQ(alignment.match(Direction::kSame, best).steps, 74);
    // The rest, which slips do not make up for, counts as drift.
    const auto path = alignment.Path(Direction::kSame, best);
    EXPECT_LE(Slips(path), 4) << stride;
    EXPECT_NEAR(static_cast<double>(path.back().node), 50.0, 4.0) << stride;
  }
}

TEST_F(WindingRoadTest, WhereTheRecentPathLacksANodeOneOfHistoryIsSkipped) {
  sigma_ = 0.01;
  model_.shape.tolerance = {0.3, 0.03};
  Add(0.0, 400.0);
  // As if wheels spun backward, or a pose or two were lost.
  const NodeIndex recent = Add(100.0, 148.0);
  Append(152.0, 200.0);
  const RelativeAlignment alignment = Align(recent);
  EXPECT_EQ(Best(alignment, Direction::kSame), 100);
  EXPECT_EQ(alignment.match(Direction::kSame, 100).steps, 49);
  const auto path = alignment.Path(Direction::kSame, 100);
  ASSERT_EQ(path.size(), 50u);
  EXPECT_EQ(path[24].node, 76);
  EXPECT_EQ(path[25].node, 74);
  EXPECT_EQ(path[49].node, 50);
  EXPECT_EQ(Slips(path), 1);
}

TEST_F(WindingRoadTest, WhereTheRecentPathHasANodeTwiceHistoryStays) {
  sigma_ = 0.01;
  model_.shape.tolerance = {0.3, 0.03};
  Add(0.0, 400.0);
  const NodeIndex recent = Add(100.0, 150.0);
  Append(150.0, 200.0);
  const RelativeAlignment alignment = Align(recent);
  EXPECT_EQ(Best(alignment, Direction::kSame), 100);
  EXPECT_EQ(alignment.match(Direction::kSame, 100).steps, 51);
  const auto path = alignment.Path(Direction::kSame, 100);
  ASSERT_EQ(path.size(), 52u);
  EXPECT_EQ(path[25].node, 75);
  EXPECT_EQ(path[26].node, 75);
  EXPECT_EQ(path[51].node, 50);
  EXPECT_EQ(Slips(path), 1);
}

TEST_F(WindingRoadTest, AnotherRoadIsWorthLessThanTheSame) {
  Add(0.0, 100.0);
  const NodeIndex recent = Add(300.0, 400.0);
  const RelativeAlignment other = Align(recent);
  double most = 0.0;
  for (NodeIndex j = 0; j < recent; ++j) {
    most =
        std::max(most, other.match(Direction::kSame, j).log_likelihood_ratio);
  }
  graph_ = PoseGraph();
  Add(300.0, 400.0);
  Add(300.0, 400.0);
  const RelativeAlignment same = Align(recent);
  EXPECT_EQ(same.match(Direction::kSame, 50).steps, 50);
  EXPECT_LT(most + 10.0, same.match(Direction::kSame, 50).log_likelihood_ratio);
}

TEST_F(WindingRoadTest, ASingleStepIsTheEndAlone) {
  Add(0.0, 20.0);
  const NodeIndex recent = Add(10.0, 10.0);
  const RelativeAlignment alignment = Align(recent);
  EXPECT_EQ(alignment.match(Direction::kSame, 5).steps, 0);
  EXPECT_EQ(alignment.match(Direction::kSame, 5).log_likelihood_ratio, 0.0);
  EXPECT_THAT(alignment.Path(Direction::kSame, 5),
              ElementsAre(PathStep{0, 5, Direction::kSame}));
  // ln N(0; 0, Gamma + R) / rho by hand: Gamma + R is diag(2 + 4, 2 + 4, 0.02 +
  // 0.01).
  EXPECT_NEAR(ScoreOf(alignment, Direction::kSame, 5),
              -1.5 * std::log(2.0 * kPi) - 0.5 * std::log(36.0 * 0.03) +
                  std::log(kPi * 200.0 * 2.0 / 2.0),
              1e-9);
}

TEST_F(WindingRoadTest, StopsWhenTold) {
  // It asks once per block.
  for (NodeIndex k = 0; graph_.size() <= 2 * 128; ++k) Add(0.0, 200.0);
  const NodeIndex recent = Add(100.0, 150.0);
  const NodeIndex query = graph_.size() - 1;
  int asked = 0;
  EXPECT_FALSE(AlignRelative({graph_, query, query - recent + 1},
                             {graph_, recent}, model_,
                             [&asked] { return ++asked == 3; }));
  EXPECT_EQ(asked, 3);
}

}  // namespace
}  // namespace revisit::core
