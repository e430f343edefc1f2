// Ends that are left out for their log-odds, and those that are kept.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <memory>
#include <set>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/block_growth.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/walked_ends.h"
#include "tests/core/graphs.h"
#include "tests/core/search/alignment/towns.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// How often each case has occurred in the trials.
struct PruningSeen {
  std::int64_t kept = 0;
  std::int64_t left_out = 0;
  std::int64_t considered = 0;
  std::int64_t of_nodes = 0;
  std::int64_t over_loops = 0;
  // Blocks of another frame in which errors grow.
  std::int64_t growing = 0;
  // More probable than a new place.
  std::int64_t seen_places = 0;
};

bool IsSought(const History& history, NodeIndex node) {
  return std::none_of(history.not_sought.begin(), history.not_sought.end(),
                      [&](const NodeRange& nodes) {
                        return nodes.first <= node && node < nodes.last;
                      });
}

// The greatest log-odds of the ends that are sought and of a new place.
double GreatestLogOdds(const History& history, const RelativeAlignment& dense) {
  double greatest = 0.0;
  for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
    for (const ScoredEnd& end : dense.ends(direction)) {
      if (IsSought(history, end.node)) greatest = std::max(greatest, end.score);
    }
  }
  return greatest;
}

// Any log share, or that of one of the ends to the last bit, or hardly more.
double LeastLogShare(std::mt19937_64& random, const RelativeAlignment& dense,
                     double greatest) {
  const ScoredEnds& ends = dense.ends(
      UniformInt(random, 0, 1) ? Direction::kSame : Direction::kOpposite);
  const int kind = UniformInt(random, 0, 3);
  if (kind < 2 || ends.empty()) return Uniform(random, -40.0, 0.0);
  const double score = ends[static_cast<std::size_t>(UniformInt(
                                random, 0, static_cast<int>(ends.size()) - 1))]
                           .score;
  return (kind == 2 ? score : std::nextafter(score, 1e9)) - greatest;
}

// A few stretches, which may overlap, have one node or reach beyond history.
std::vector<NodeRange> RandomRanges(std::mt19937_64& random,
                                    NodeIndex history) {
  std::vector<NodeRange> ranges;
  for (int k = UniformInt(random, -2, 3); k > 0; --k) {
    const NodeIndex first = UniformInt(random, 0, static_cast<int>(history));
    ranges.push_back({first, first + UniformInt(random, 1, 200)});
  }
  return ranges;
}

// A pruned search finds what an unbounded search does among the ends that are
// sought, bit for bit, except for ends with lower log-odds.
void ExpectTheSameButForLowOdds(std::mt19937_64& random, const Town& town,
                                PruningSeen* seen) {
  const auto dense =
      AlignRelative(town.Asked(), town.Past(), town.model, nullptr);
  ASSERT_TRUE(dense);
  RelativeModel model = town.model;
  History history = town.Past();
  history.not_sought = RandomRanges(random, town.history);
  const double greatest = GreatestLogOdds(history, *dense);
  model.least_log_share = LeastLogShare(random, *dense, greatest);
  const double least_log_odds = model.least_log_share + greatest;
  SCOPED_TRACE(::testing::Message()
               << town.Text() << ", least log-odds " << least_log_odds
               << ", greatest " << greatest);
  seen->seen_places += greatest > 0.0;
  BlockBounds bounds(model.similarity.state_space);
  bounds.Extend(town.graph);
  if (UniformInt(random, 0, 4) > 0) history.block_bounds = &bounds;
  std::vector<char> growing;
  if (!town.relation.is_own() && town.relation.tie().other_node) {
    growing = BlocksGrowing(model.similarity.state_space, town.graph,
                            {town.first, town.history},
                            *town.relation.tie().other_node);
    history.growing = &growing;
    seen->growing += std::count(growing.begin(), growing.end(), 1);
  }
  const auto pruned = AlignRelative(town.Asked(), history, model, nullptr);
  ASSERT_TRUE(pruned);

  std::set<NodeIndex> kept;
  for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
    const ScoredEnds& ends = pruned->ends(direction);
    auto end = ends.begin();
    for (const ScoredEnd& of_all : dense->ends(direction)) {
      SCOPED_TRACE(::testing::Message()
                   << "way " << IndexOf(direction) << " end " << of_all.node
                   << " score " << of_all.score);
      const bool found = end != ends.end() && end->node == of_all.node;
      // Written so that NaN is left out.
      ASSERT_EQ(found, IsSought(history, of_all.node) &&
                           of_all.score >= least_log_odds);
      if (!found) {
        ++seen->left_out;
        continue;
      }
      ++seen->kept;
      kept.insert(of_all.node);
      EXPECT_EQ(end->score, of_all.score);
      ++end;
      const ShapeMatch& match = pruned->match(direction, of_all.node);
      const ShapeMatch& wanted = dense->match(direction, of_all.node);
      EXPECT_EQ(match.log_likelihood_ratio, wanted.log_likelihood_ratio);
      EXPECT_EQ(match.squared_innovations, wanted.squared_innovations);
      EXPECT_EQ(match.squared_end_difference, wanted.squared_end_difference);
      EXPECT_EQ(match.steps, wanted.steps);
      if (UniformInt(random, 0, 19) > 0) continue;
      const auto path = pruned->Path(direction, of_all.node);
      EXPECT_EQ(path, dense->Path(direction, of_all.node));
      EXPECT_EQ(path.back().t, match.steps);
      for (std::size_t k = 1; k < path.size(); ++k) {
        seen->over_loops += std::abs(path[k].node - path[k - 1].node) > 2;
      }
    }
    ASSERT_EQ(end, ends.end());
  }
  EXPECT_EQ(dense->considered(), town.history - town.first);
  EXPECT_LE(pruned->considered(), dense->considered());
  EXPECT_GE(pruned->considered(), static_cast<NodeIndex>(kept.size()));
  seen->considered += pruned->considered();
  seen->of_nodes += dense->considered();
}

// Covariances that have nothing to do with the path, at all nodes or at some.
void ClaimAnything(std::mt19937_64& random, Town* town) {
  PoseGraph graph;
  const int one_in = UniformInt(random, 0, 1) ? 1 : 500;
  const double scale = std::pow(10.0, Uniform(random, -2.0, 2.0));
  for (NodeIndex i = 0; i < town->graph.size(); ++i) {
    Node node = town->graph.node(i);
    if (UniformInt(random, 1, one_in) == 1) {
      node.covariance = RandomCovariance(
          random, scale * std::pow(10.0, Uniform(random, -0.5, 0.5)));
    }
    graph.AddNode(node, town->graph.SegmentStart(i) == i,
                  town->graph.transition(i));
  }
  for (const auto& [a, b] : town->graph.LoopEdges()) graph.AddLoopEdge(a, b);
  town->graph = graph;
}

void Print(const PruningSeen& seen) {
  std::cout << seen.kept << " ends kept, " << seen.left_out
            << " left out; walked back from " << seen.considered << " nodes of "
            << seen.of_nodes << "; steps over loop closures " << seen.over_loops
            << "; seen before " << seen.seen_places << "; blocks that grow "
            << seen.growing << "\n";
}

void ExpectTheSameEnds(const RelativeAlignment& a, const RelativeAlignment& b,
                       Direction direction) {
  const ScoredEnds& ends = a.ends(direction);
  ASSERT_EQ(ends.size(), b.ends(direction).size());
  for (std::size_t i = 0; i < ends.size(); ++i) {
    ASSERT_EQ(ends[i].node, b.ends(direction)[i].node);
    ASSERT_EQ(ends[i].score, b.ends(direction)[i].score);
    const ShapeMatch& match = a.match(direction, ends[i].node);
    const ShapeMatch& other = b.match(direction, ends[i].node);
    EXPECT_EQ(match.log_likelihood_ratio, other.log_likelihood_ratio);
    EXPECT_EQ(match.squared_innovations, other.squared_innovations);
    EXPECT_EQ(match.squared_end_difference, other.squared_end_difference);
    EXPECT_EQ(match.steps, other.steps);
  }
}

TEST(AlignRelativePruningTest,
     PathsThatAnotherSearchHasWalkedAreThoseOfItsOwn) {
  std::mt19937_64 random = SeededRandom();
  std::size_t found = 0;
  for (int trial = 0; trial < 300; ++trial) {
    const Town town = RandomTown(random);
    SCOPED_TRACE(town.Text());
    RelativeModel strict = town.model;
    strict.over_loops = false;
    strict.least_log_share = Uniform(random, -5.0, 0.0);
    RelativeModel lenient = strict;
    lenient.least_log_share = Uniform(random, -40.0, -5.0);
    if (town.model.drifts.empty()) lenient.scales = {{0.5, -1.0}, {2.0, -0.5}};
    AlignmentParts parts;
    parts.walked = std::make_shared<std::array<WalkedEnds, 2>>();
    ASSERT_TRUE(
        AlignRelative(town.Asked(), town.Past(), strict, nullptr, &parts));
    const auto after =
        AlignRelative(town.Asked(), town.Past(), lenient, nullptr, &parts);
    const auto alone =
        AlignRelative(town.Asked(), town.Past(), lenient, nullptr);
    ASSERT_TRUE(after && alone);
    for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
      ExpectTheSameEnds(*after, *alone, direction);
      found += alone->ends(direction).size();
    }
  }
  EXPECT_GT(found, 1000u);
}

TEST(AlignRelativePruningTest, LeavesOutLowOddsAloneInSmallTowns) {
  std::mt19937_64 random = SeededRandom();
  PruningSeen seen;
  for (int trial = 0; trial < 3000 && !::testing::Test::HasFailure(); ++trial) {
    SCOPED_TRACE(trial);
    Town town = RandomTown(random);
    if (UniformInt(random, 0, 3) == 0) town.model.last_confirmed.reset();
    if (UniformInt(random, 0, 4) == 0) ClaimAnything(random, &town);
    for (int k = 0; k < 3; ++k) {
      ExpectTheSameButForLowOdds(random, town, &seen);
    }
  }
  Print(seen);
  EXPECT_GT(seen.kept, 10000);
  EXPECT_GT(seen.left_out, 10000);
  EXPECT_GT(seen.over_loops, 500);
  EXPECT_GT(seen.seen_places, 500);
}

TEST(AlignRelativePruningTest,
     LeavesOutLowOddsAloneAndWholeBlocksInLargeTowns) {
  std::mt19937_64 random = SeededRandom();
  PruningSeen honest;
  PruningSeen nonsense;
  for (int trial = 0; trial < 60 && !::testing::Test::HasFailure(); ++trial) {
    SCOPED_TRACE(trial);
    Town town = RandomTown(random, UniformInt(random, 10, 60));
    if (UniformInt(random, 0, 3) > 0) town.model.last_confirmed.reset();
    const bool anything = UniformInt(random, 0, 2) == 0;
    if (anything) ClaimAnything(random, &town);
    for (int k = 0; k < 3; ++k) {
      ExpectTheSameButForLowOdds(random, town, anything ? &nonsense : &honest);
    }
  }
  Print(honest);
  Print(nonsense);
  EXPECT_GT(honest.kept, 1000);
  EXPECT_LT(4 * honest.considered, 3 * honest.of_nodes);
  EXPECT_GT(nonsense.kept, 1000);
  EXPECT_GT(nonsense.left_out, 1000);
}

TEST(AlignRelativePruningTest, LeavesOutLowOddsAloneInOtherFrames) {
  std::mt19937_64 random = SeededRandom();
  PruningSeen small;
  for (int trial = 0; trial < 1000 && !::testing::Test::HasFailure(); ++trial) {
    SCOPED_TRACE(trial);
    Town town = RandomTown(random);
    if (!MoveApart(random, &town)) continue;
    if (UniformInt(random, 0, 4) == 0) ClaimAnything(random, &town);
    for (int k = 0; k < 3; ++k) {
      ExpectTheSameButForLowOdds(random, town, &small);
    }
  }
  PruningSeen large;
  for (int trial = 0; trial < 80 && !::testing::Test::HasFailure(); ++trial) {
    SCOPED_TRACE(trial);
    Town town = RandomTown(random, UniformInt(random, 10, 60));
    if (!MoveApart(random, &town)) continue;
    if (UniformInt(random, 0, 3) == 0) ClaimAnything(random, &town);
    for (int k = 0; k < 3; ++k) {
      ExpectTheSameButForLowOdds(random, town, &large);
    }
  }
  Print(small);
  Print(large);
  EXPECT_GT(small.kept, 5000);
  EXPECT_GT(small.left_out, 5000);
  EXPECT_GT(large.kept, 1000);
  EXPECT_GT(large.growing, 50);
  EXPECT_LT(20 * large.considered, 19 * large.of_nodes);
}

}  // namespace
}  // namespace revisit::core
