#include "core/drive/retention.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "tests/oracle/plain_retention.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using Stamp = std::optional<std::int64_t>;

constexpr std::int64_t kSecond = 1'000'000'000;
constexpr std::int64_t kHour = 3600 * kSecond;

// The nodes to drop, at once.
std::vector<NodeRange> FindDroppable(const PoseGraph& graph,
                                     const RetentionOptions& options,
                                     const RetentionNeeds& needs,
                                     Stamp latest = std::nullopt) {
  DroppableSearch search(graph, options, needs, latest);
  while (!search.Advance(graph.size() + 1)) {
  }
  return search.Droppable({});
}

constexpr NodeIndex kLap = 314;
// The first node that stays where laps from this one on are wanted: with the
// path to it, and but for two nodes near which the last lap ends.
constexpr NodeIndex FirstOfLap(NodeIndex lap) { return lap * kLap + 2 - 49; }

// Laps of a circle of 100 m, a node each 2 m and each second.
class Laps {
 public:
  // `aside`: how far outside of the circle; `turned`: driven the other way.
  Laps& Drive(int laps, double deviation = 0.5, double aside = 0.0,
              bool turned = false) {
    for (int k = 0; k < laps * kLap; ++k) {
      const double angle = (turned ? -1.0 : 1.0) * 2.0 * kPi *
                           static_cast<double>(k) / static_cast<double>(kLap);
      Node node;
      node.sequence = static_cast<std::uint64_t>(graph.size()) + 1;
      node.stamp_ns = graph.size() * 1'000'000'000;
      node.travelled_meters = 2.0 * static_cast<double>(graph.size());
      const double radius = 100.0 + aside;
      node.pose = {radius * std::cos(angle), radius * std::sin(angle), 0.0,
                   WrapHeading(angle + (turned ? -0.5 : 0.5) * kPi)};
      for (int i = 0; i < 3; ++i) {
        node.covariance(i, i) = deviation * deviation;
      }
      node.covariance(3, 3) = 1e-4;
      graph.AddNode(node, graph.size() == 0, std::nullopt);
    }
    return *this;
  }

  PoseGraph graph;
};

RetentionNeeds Needs() {
  RetentionNeeds needs;
  needs.correlation = CorrelationModel::kIndependent;
  needs.aligned_nodes = 50;
  needs.least_nodes = 50;
  needs.newest_nodes = 100;
  needs.agreeing_nodes = 11;
  return needs;
}

RetentionOptions Passes(int passes) {
  RetentionOptions options;
  options.max_passes = passes;
  return options;
}

NodeIndex Count(const std::vector<NodeRange>& ranges) {
  NodeIndex count = 0;
  for (const NodeRange& range : ranges) count += range.last - range.first;
  return count;
}

std::string Text(const std::vector<NodeRange>& ranges) {
  std::string text;
  for (const NodeRange& range : ranges) {
    text += "[" + std::to_string(range.first) + ", " +
            std::to_string(range.last) + ") ";
  }
  return text;
}

TEST(RetentionTest, KeepsEverythingUnlessItIsAsked) {
  const Laps laps = Laps().Drive(10);
  EXPECT_EQ(Text(FindDroppable(laps.graph, {}, Needs())), "");
}

TEST(RetentionTest, KeepsTheLastPassesOfAPlaceThatAreAboutAsGood) {
  const Laps laps = Laps().Drive(10);
  const auto dropped = FindDroppable(laps.graph, Passes(3), Needs());
  EXPECT_EQ(Text(dropped), "[0, " + std::to_string(FirstOfLap(7)) + ") ");
}

TEST(RetentionTest, KeepsTheBestPassesWhereverTheyAre) {
  Laps laps;
  laps.Drive(3, 1.5).Drive(2, 0.5).Drive(4, 1.5);
  RetentionNeeds needs = Needs();
  needs.newest_nodes = 20;
  const auto dropped = FindDroppable(laps.graph, Passes(2), needs);
  ASSERT_EQ(dropped.size(), 2u) << Text(dropped);
  EXPECT_EQ(dropped[0].first, 0);
  EXPECT_EQ(dropped[0].last, FirstOfLap(3));
  EXPECT_EQ(dropped[1].first, 5 * kLap);
  EXPECT_EQ(dropped[1].last, 9 * kLap - 20);
}

TEST(RetentionTest, KeepsWhatIsAnotherRoadOrAnotherDirection) {
  Laps laps;
  laps.Drive(2).Drive(2, 0.5, 8.0).Drive(2, 0.5, 0.0, true).Drive(1, 0.5, 90.0);
  EXPECT_EQ(Text(FindDroppable(laps.graph, Passes(2), Needs())), "");
}

TEST(RetentionTest, KeepsPlacesThatAreNotSure) {
  EXPECT_EQ(
      Text(FindDroppable(Laps().Drive(10, 6.0).graph, Passes(2), Needs())), "");
  // Dead reckoning whose covariances grow: 2 m in a lap.
  Laps reckoned;
  for (int lap = 1; lap <= 9; ++lap) reckoned.Drive(1, 20.0 * lap);
  RetentionNeeds needs = Needs();
  needs.correlation = CorrelationModel::kDeadReckoning;
  EXPECT_EQ(Text(FindDroppable(reckoned.graph, Passes(2), needs)), "");
}

TEST(RetentionTest, KeepsWhatLoopClosuresReferToWithThePathThere) {
  const Laps laps = Laps().Drive(10);
  RetentionNeeds needs = Needs();
  needs.loop_ends = {1000};
  const auto dropped = FindDroppable(laps.graph, Passes(3), needs);
  EXPECT_EQ(Text(dropped),
            "[0, 950) [1006, " + std::to_string(FirstOfLap(7)) + ") ");
}

TEST(RetentionTest, KeepsWhatLoopClosuresReferToThatCameWhileItLooked) {
  const Laps laps = Laps().Drive(10);
  RetentionNeeds needs = Needs();
  DroppableSearch search(laps.graph, Passes(3), needs, std::nullopt);
  while (!search.Advance(100)) {
  }
  needs.loop_ends = {5 * kLap + 40, laps.graph.size() - 1};
  EXPECT_EQ(Text(search.Droppable(needs.loop_ends)),
            Text(FindDroppable(laps.graph, Passes(3), needs)));
}

TEST(RetentionTest, KeepsThePathThatLeadsToWhatItKeeps) {
  // Only one lap leaves the circle, outwards, for a quarter of it.
  Laps laps;
  laps.Drive(3);
  const NodeIndex from = laps.graph.size();
  laps.Drive(1, 0.5, 60.0).Drive(6);
  const auto dropped = FindDroppable(laps.graph, Passes(2), Needs());
  ASSERT_EQ(dropped.size(), 2u) << Text(dropped);
  EXPECT_EQ(dropped[0].last, from - Needs().aligned_nodes + 1);
  EXPECT_EQ(dropped[1].first, from + kLap);
}

TEST(RetentionTest, DropsNoShortStretches) {
  RetentionNeeds needs = Needs();
  needs.least_nodes = 8 * kLap;
  EXPECT_EQ(Text(FindDroppable(Laps().Drive(10).graph, Passes(3), needs)), "");
}

TEST(RetentionTest, DropsWhatIsTooOldByTheStampsOfThePosesAlone) {
  const Laps laps = Laps().Drive(10);
  RetentionOptions options;
  options.max_age_ns = std::int64_t{500} * 1'000'000'000;
  const NodeIndex size = laps.graph.size();
  // The newest stamp is ten nodes before the last, where eleven agree, and what
  // it was before the newest nodes, where these took more than a tenth of the
  // age.
  EXPECT_EQ(Text(FindDroppable(laps.graph, options, Needs())),
            "[0, " + std::to_string(size - 100 - 511) + ") ");
  options.max_age_ns = 1000 * kSecond;
  EXPECT_EQ(Text(FindDroppable(laps.graph, options, Needs())),
            "[0, " + std::to_string(size - 1011) + ") ");
  // The newest nodes stay however old they are.
  options.max_age_ns = kLeastAgeNanoseconds;
  EXPECT_EQ(Text(FindDroppable(laps.graph, options, Needs())),
            "[0, " + std::to_string(size - 100 - 12) + ") ");
}

TEST(RetentionTest, CountsWhatEachRuleDrops) {
  const Laps laps = Laps().Drive(10);
  RetentionOptions options = Passes(3);
  options.max_age_ns = 2500 * kSecond;
  DroppableSearch search(laps.graph, options, Needs(), std::nullopt);
  while (!search.Advance(1000)) {
  }
  const auto ranges = search.Droppable({});
  const NodeIndex old = laps.graph.size() - 2511;
  EXPECT_EQ(search.CountTooOld(ranges), old);
  EXPECT_EQ(Count(ranges), FirstOfLap(7));
}

TEST(RetentionTest, OldPassesCoverNothing) {
  const Laps laps = Laps().Drive(4, 0.5).Drive(6, 3.0);
  RetentionOptions options = Passes(2);
  options.max_age_ns = (6 * kLap - 11) * kSecond;
  const auto dropped = FindDroppable(laps.graph, options, Needs());
  // Four old laps, and four of the six that are younger.
  ASSERT_EQ(dropped.size(), 1u) << Text(dropped);
  EXPECT_EQ(dropped[0].first, 0);
  EXPECT_NEAR(static_cast<double>(dropped[0].last),
              static_cast<double>(FirstOfLap(8)), 2.0);
}

TEST(RetentionTest, HasTheSequencesThatOtherNodesDoNotNeed) {
  PoseGraph graph;
  for (int i = 0; i < 6; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(10 * i) + 1;
    node.fraction = i == 3 ? 0.0 : 0.5;
    graph.AddNode(node, i == 0 || i == 3, std::nullopt);
  }
  const auto text = [&](NodeIndex first, NodeIndex last) {
    const SequenceRange range = SequencesOf(graph, {first, last});
    return std::to_string(range.first) + "-" + std::to_string(range.last);
  };
  EXPECT_EQ(text(0, 2), "1-11");
  EXPECT_EQ(text(1, 2), "12-11");
  // Node 3 starts a segment at pose 31.
  EXPECT_EQ(text(1, 3), "12-30");
  EXPECT_EQ(text(3, 5), "31-41");
}

// Rounds on roads that share stretches, with errors of any size.
PoseGraph AnyGraph(std::mt19937_64& random, double spacing, bool spatial) {
  PoseGraph graph;
  const int size = UniformInt(random, 1, 1500);
  const double extent = Uniform(random, 10.0, 60.0);
  double travelled = 0.0;
  double angle = 0.0;
  double deviation = Uniform(random, 0.1, 4.0);
  std::int64_t clock = 0;
  const int wrong = UniformInt(random, 1, 50);
  const int nodes_per_pose = UniformInt(random, 1, 3);
  for (int k = 0; k < size; ++k) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(k / nodes_per_pose) + 1;
    if (UniformInt(random, 0, 20) > 0) {
      node.stamp_ns = (k + clock) * kSecond;
      if (UniformInt(random, 0, wrong) == 0) {
        *node.stamp_ns += kHour * UniformInt(random, -1000, 1000);
      }
    }
    if (UniformInt(random, 0, 500) == 0) {
      clock += UniformInt(random, -500, 1500);
    }
    node.travelled_meters = travelled;
    node.pose = {
        extent * std::cos(angle) + Normal(random, deviation),
        0.5 * extent * std::sin(2.0 * angle) + Normal(random, deviation),
        spatial ? 8.0 * std::sin(angle / 7.0) : 0.0,
        WrapHeading(2.0 * angle + Normal(random, 0.05))};
    for (int i : {0, 1, 2}) {
      node.covariance(i, i) = deviation * deviation * Uniform(random, 0.5, 2.0);
    }
    if (!spatial) node.covariance(2, 2) = 0.0;
    node.covariance(3, 3) = 0.01;
    const bool jumps = k == 0 || UniformInt(random, 0, 200) == 0;
    graph.AddNode(node, jumps, std::nullopt);
    travelled += UniformInt(random, 0, 300) == 0 ? 500.0 : spacing;
    angle += spacing / extent;
    if (UniformInt(random, 0, 60) == 0) deviation = Uniform(random, 0.1, 4.0);
  }
  return graph;
}

// A few nodes at a time, while the vehicle drives on. The graph of the search
// begins with the nodes of `graph`, and the last of them stays the newest.
std::vector<NodeRange> InParts(std::mt19937_64& random, const PoseGraph& graph,
                               const RetentionOptions& options,
                               const RetentionNeeds& needs, Stamp latest) {
  PoseGraph growing;
  const auto add = [&](Node node) {
    const NodeIndex i = growing.size();
    const bool starts =
        i == 0 || (i < graph.size() && graph.SegmentStart(i) == i);
    growing.AddNode(node, starts, std::nullopt);
  };
  for (NodeIndex i = 0; i < graph.size(); ++i) add(graph.node(i));
  DroppableSearch search(growing, options, needs, latest);
  while (!search.Advance(UniformInt(random, 1, 100))) {
    Node next = growing.node(growing.size() - 1);
    ++next.sequence;
    next.travelled_meters += needs.spacing_meters;
    if (next.stamp_ns) *next.stamp_ns += 1'000'000'000'000;
    add(next);
  }
  if (graph.size() > 100) {
    EXPECT_GT(growing.size(), graph.size());
  }
  return search.Droppable({});
}

TEST(RetentionTest, PassesAreCountedWithinARecordingWhoseEndsStay) {
  const Laps laps = Laps().Drive(10);
  RetentionNeeds needs = Needs();
  needs.recording_starts = {0, 5 * kLap};
  EXPECT_EQ(Text(FindDroppable(laps.graph, Passes(3), needs)),
            "[1, " + std::to_string(FirstOfLap(2)) + ") [" +
                std::to_string(5 * kLap + 1) + ", " +
                std::to_string(FirstOfLap(7)) + ") ");
}

TEST(RetentionTest, IsThatOfThePlainComparisonOfAllNodes) {
  std::mt19937_64 random = SeededRandom();
  NodeIndex dropped = 0;
  NodeIndex kept = 0;
  for (int round = 0; round < 60; ++round) {
    const bool spatial = round % 3 == 0;
    RetentionNeeds needs;
    needs.state_space = spatial ? StateSpace::kSpatial : StateSpace::kPlanar;
    const CorrelationModel models[] = {
        CorrelationModel::kIndependent, CorrelationModel::kCorrelatedFixes,
        CorrelationModel::kDeadReckoning, CorrelationModel::kFilter};
    needs.correlation = models[round % 4];
    needs.tolerance_meters = Uniform(random, 0.0, 4.0);
    needs.spacing_meters = Uniform(random, 0.4, 6.0);
    needs.separation_meters = Uniform(random, 0.0, 100.0);
    needs.aligned_nodes = UniformInt(random, 1, 40);
    needs.newest_nodes = UniformInt(random, 1, 200);
    needs.least_nodes = UniformInt(random, 1, 30);
    needs.agreeing_nodes = UniformInt(random, 1, 30);
    const PoseGraph graph = AnyGraph(random, needs.spacing_meters, spatial);
    for (int k = UniformInt(random, 0, 3); k-- > 0;) {
      needs.loop_ends.push_back(
          UniformInt(random, 0, static_cast<int>(graph.size()) - 1));
    }
    for (int k = UniformInt(random, -1, 3); k-- > 0;) {
      needs.recording_starts.push_back(
          UniformInt(random, 0, static_cast<int>(graph.size()) - 1));
    }
    std::sort(needs.recording_starts.begin(), needs.recording_starts.end());
    RetentionOptions options;
    options.max_passes = UniformInt(random, 0, 4);
    if (UniformInt(random, 0, 2) == 0) {
      options.max_age_ns =
          std::int64_t{UniformInt(random, 1, 1500)} * 1'000'000'000;
    }
    const Stamp latest = round % 2 == 0 ? std::nullopt : Stamp(kHour);
    const std::string plain =
        Text(PlainRetention(graph, options, needs, latest).Droppable());
    const auto found = FindDroppable(graph, options, needs, latest);
    EXPECT_EQ(Text(found), plain) << "round " << round;
    EXPECT_EQ(Text(InParts(random, graph, options, needs, latest)), plain)
        << "round " << round;
    dropped += Count(found);
    kept += graph.size() - Count(found);
  }
  EXPECT_GT(dropped, 3000);
  EXPECT_GT(kept, 3000);
}

}  // namespace
}  // namespace revisit::core
