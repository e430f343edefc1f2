#include "core/search/belief/drive_belief.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <set>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/search/belief/mark.h"

namespace revisit::core {
namespace {

// A straight road with a node every two metres.
PoseGraph StraightRoad(NodeIndex nodes) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < nodes; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose.x = node.travelled_meters;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  return graph;
}

// A mark that speaks for one scale, and for a place.
MarkEvidence Speaking(std::size_t scale, double nats) {
  MarkEvidence mark;
  mark.node = 500;
  mark.matched = 100;
  mark.log_evidence[scale] = nats;
  mark.log_all_evidence[scale] = nats;
  mark.log_matched_odds.fill(-1.0);
  mark.log_matched_odds[scale] = nats;
  return mark;
}

// A mark of which all places together have ln odds of 12, under each scale, and
// that which it found so much.
MarkEvidence MarkAt(NodeIndex node, NodeIndex matched,
                    double log_matched_odds) {
  MarkEvidence mark;
  mark.node = node;
  mark.log_evidence.fill(12.0);
  mark.log_all_evidence.fill(12.0);
  mark.matched = matched;
  mark.log_matched_odds.fill(log_matched_odds);
  return mark;
}

TEST(DriveBeliefTest, BeforeTheFirstMarkTheClaimsAreTheMostProbable) {
  const DriveBelief belief;
  EXPECT_NEAR(belief.Scale().scale, 1.0, 0.01);
  EXPECT_LT(belief.Scale().low, 0.5);
  EXPECT_GT(belief.Scale().high, 2.0);
  double sum = 0.0;
  for (const WeighedScale& scale : belief.Scales()) {
    sum += std::exp(scale.log_weight);
  }
  EXPECT_NEAR(sum, 1.0, 1e-12);
  EXPECT_EQ(belief.AllScales().size(), kScales);
  EXPECT_TRUE(belief.drifts(0).empty());
}

TEST(DriveBeliefTest, LearnsScalesAboveAndBelowTheClaims) {
  for (const std::size_t scale : {std::size_t{2}, std::size_t{6}}) {
    DriveBelief belief;
    for (int mark = 0; mark < 60; ++mark) {
      belief.LearnScale(Speaking(scale, 5.0), 1);
    }
    EXPECT_NEAR(std::log(belief.Scale().scale), LogScale(scale), 0.05);
    EXPECT_LE(belief.Scale().low, std::exp(LogScale(scale)));
    EXPECT_GE(belief.Scale().high, std::exp(LogScale(scale)));
  }
}

TEST(DriveBeliefTest, MarksFartherApartCountForMoreUpToAWholeObservation) {
  const auto learned = [](std::int64_t stride) {
    DriveBelief belief;
    belief.LearnScale(Speaking(6, 3.0), stride);
    return belief.Scale().scale;
  };
  EXPECT_LT(learned(1), learned(2));
  EXPECT_LT(learned(4), learned(10));
  EXPECT_EQ(learned(16), learned(1024));
}

TEST(DriveBeliefTest, AMarkWithoutAnyPlaceTeachesNothing) {
  const PoseGraph graph = StraightRoad(600);
  DriveBelief belief;
  MarkEvidence nothing;
  nothing.node = 500;
  belief.LearnScale(nothing, 1);
  belief.LearnDrift(graph, Recordings(), nothing, 800.0);
  EXPECT_EQ(belief.Scale().scale, DriveBelief().Scale().scale);
  EXPECT_TRUE(belief.drifts(0).empty());
}

TEST(DriveBeliefTest, ASurePlaceShowsTheDriftWithinReach) {
  const PoseGraph graph = StraightRoad(2000);
  DriveBelief belief;
  belief.LearnDrift(graph, Recordings(), MarkAt(1500, 700, 12.0 - 1e-6), 800.0);
  ASSERT_EQ(belief.drifts(0).size(), 1u);
  const WeighedDrift drift = belief.drifts(0)[0];
  ASSERT_EQ(drift.pairs.size(), 1u);
  EXPECT_EQ(drift.pairs[0].query, 1500);
  EXPECT_EQ(drift.pairs[0].matched, 700);
  // Less sure than the mark: nothing is certain.
  EXPECT_NEAR(std::exp(drift.log_weight), 0.999, 1e-9);
  EXPECT_NEAR(2.0 * static_cast<double>(drift.reach.first), 600.0, 2.0);
  EXPECT_NEAR(2.0 * static_cast<double>(drift.reach.last), 2200.0, 2.0);
}

TEST(DriveBeliefTest, AnUnsurePlaceShowsNoDrift) {
  const PoseGraph graph = StraightRoad(2000);
  DriveBelief belief;
  belief.LearnDrift(graph, Recordings(), MarkAt(1500, 700, 11.7), 800.0);
  EXPECT_TRUE(belief.drifts(0).empty());
}

TEST(DriveBeliefTest, LaterPlacesOutweighEarlierOnesAndTheBestAreKept) {
  const PoseGraph graph = StraightRoad(3000);
  DriveBelief belief;
  for (NodeIndex k = 0; k < 5; ++k) {
    belief.LearnDrift(graph, Recordings(),
                      MarkAt(2000 + 25 * k, 700 + 25 * k, 11.95), 800.0);
  }
  ASSERT_EQ(belief.drifts(0).size(), kMostDrifts);
  EXPECT_EQ(belief.drifts(0).back().pairs.back().query, 2100);
  double sum = 0.0;
  for (const WeighedDrift& drift : belief.drifts(0)) {
    sum += std::exp(drift.log_weight);
    EXPECT_LE(drift.log_weight, belief.drifts(0).back().log_weight);
  }
  EXPECT_LT(sum, 1.0);
}

TEST(DriveBeliefTest, ADriftIsShownByTheNewestPlacesTogether) {
  const PoseGraph graph = StraightRoad(3000);
  DriveBelief belief;
  for (NodeIndex k = 0; k < 10; ++k) {
    // One of them is not sure enough.
    belief.LearnDrift(
        graph, Recordings(),
        MarkAt(2000 + 25 * k, 700 + 25 * k, k == 8 ? 10.0 : 11.95), 800.0);
  }
  const std::vector<ConfirmedLoop> pairs = belief.drifts(0).back().pairs;
  ASSERT_EQ(pairs.size(), kMostPairs);
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const NodeIndex k =
        i + 1 < pairs.size() ? static_cast<NodeIndex>(i) + 3 : 9;
    EXPECT_EQ(pairs[i].query, 2000 + 25 * k);
    EXPECT_EQ(pairs[i].matched, 700 + 25 * k);
  }
}

TEST(DriveBeliefTest, ADriftReachesNoFartherThanToItsMark) {
  const PoseGraph graph = StraightRoad(3000);
  DriveBelief belief;
  belief.LearnDrift(graph, Recordings(), MarkAt(1000, 700, 11.99), 1500.0);
  ASSERT_EQ(belief.drifts(0).size(), 1u);
  EXPECT_EQ(belief.drifts(0)[0].reach.last, 1000);
}

TEST(MarkLineTest, AMarkIsTheFirstNodeAtOrAfterItsDistance) {
  const PoseGraph graph = StraightRoad(600);
  const DroppedStretches none;
  const MarkLine line{graph, 50.0, none};
  EXPECT_EQ(line.NodeOf(1), 25);
  EXPECT_EQ(line.NodeOf(4), 100);
  // At least a spacing before the node.
  EXPECT_EQ(line.LastBefore(0), -1);
  EXPECT_EQ(line.LastBefore(49), 0);
  EXPECT_EQ(line.LastBefore(50), 1);
  EXPECT_EQ(line.LastBefore(74), 1);
}

TEST(ScaleMarksTest, AreFewAndWereAskedForBefore) {
  std::set<std::int64_t> asked;
  for (std::int64_t last = -1; last < 3000; ++last) {
    const ScaleMarks marks(last);
    EXPECT_LE(marks.marks.size(), static_cast<std::size_t>(kMostScaleMarks));
    if (last > 10) {
      EXPECT_GE(2 * marks.marks.size() + 2,
                static_cast<std::size_t>(std::min(last, kMostScaleMarks)));
    }
    for (const std::int64_t mark : marks.marks) {
      EXPECT_LE(mark, last);
      if (mark < last) {
        EXPECT_EQ(asked.count(mark), 1u) << mark << " up to " << last;
      }
      asked.insert(mark);
    }
  }
}

TEST(MarkMemoryTest, ForgetsWhereSettingsChanged) {
  MarkMemory memory;
  memory.Enter(1);
  memory.Keep(7, Speaking(3, 1.0));
  memory.Enter(1);
  ASSERT_NE(memory.Find(7), nullptr);
  EXPECT_EQ(memory.Find(7)->log_evidence[3], 1.0);
  EXPECT_EQ(memory.Find(8), nullptr);
  memory.Enter(2);
  EXPECT_EQ(memory.Find(7), nullptr);
}

TEST(MarkMemoryTest, ForgetsWhatIsNotNeededOnceThereIsMuch) {
  MarkMemory memory;
  for (std::int64_t mark = 1; mark <= 10; ++mark) {
    memory.Keep(mark, Speaking(3, 1.0));
  }
  const auto even = [](std::int64_t mark) { return mark % 2 == 0; };
  memory.Tidy(10, even);
  EXPECT_EQ(memory.size(), 10u);
  memory.Tidy(9, even);
  EXPECT_EQ(memory.size(), 5u);
  EXPECT_NE(memory.Find(4), nullptr);
  EXPECT_EQ(memory.Find(5), nullptr);
}

}  // namespace
}  // namespace revisit::core
