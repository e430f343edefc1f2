#include "core/drive/stamps.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/retention.h"
#include "tests/oracle/plain_retention.h"

namespace revisit::core {
namespace {

using ::testing::AnyOf;
using ::testing::Each;
using ::testing::HasSubstr;
using ::testing::StartsWith;

using Stamp = std::optional<std::int64_t>;

constexpr std::int64_t kDay = std::int64_t{24} * 3600 * 1'000'000'000;

// A node each two metres of a straight road, and each hour: 10,000 nodes are
// 417 days. `stamp` says what the clock of the vehicle says after so many
// hours.
PoseGraph Road(const std::function<Stamp(NodeIndex hour)>& stamp,
               NodeIndex size = 10'000) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.stamp_ns = stamp(i);
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose = {node.travelled_meters, 0.0, 0.0, 0.0};
    for (int k = 0; k < 4; ++k) node.covariance(k, k) = 1e-2;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  return graph;
}

std::int64_t Hours(NodeIndex hours) { return hours * (kDay / 24); }

std::string TextOf(const std::vector<NodeRange>& ranges) {
  std::string text;
  for (const NodeRange& range : ranges) {
    text += "[" + std::to_string(range.first) + ", " +
            std::to_string(range.last) + ") ";
  }
  return text;
}

// The nodes of a road that are dropped where poses older than this are not
// kept.
std::string DroppedOf(const PoseGraph& graph, std::int64_t days,
                      Stamp latest = std::nullopt) {
  RetentionOptions options;
  options.max_age_ns = days * kDay;
  RetentionNeeds needs;
  needs.correlation = CorrelationModel::kIndependent;
  needs.newest_nodes = 100;
  needs.agreeing_nodes = 11;
  DroppableSearch search(graph, options, needs, latest);
  while (!search.Advance(graph.size())) {
  }
  const std::string dropped = TextOf(search.Droppable({}));
  EXPECT_EQ(dropped,
            TextOf(PlainRetention(graph, options, needs, latest).Droppable()));
  return dropped;
}

// By stamps that are right, 365 days and ten nodes stay.
constexpr char kRight[] = "[0, 1229) ";

TEST(StampsTest, AYearOfRightStampsStays) {
  EXPECT_EQ(DroppedOf(Road(Hours), 365), kRight);
}

TEST(StampsTest, OneWrongStampDropsNothing) {
  const std::int64_t wrong[] = {Hours(24 * 365 * 130), -Hours(24 * 365 * 50),
                                std::numeric_limits<std::int64_t>::max(),
                                std::numeric_limits<std::int64_t>::min()};
  for (const std::int64_t stamp : wrong) {
    for (const NodeIndex at :
         {NodeIndex{9999}, NodeIndex{9950}, NodeIndex{9899}, NodeIndex{5000}}) {
      const auto graph = Road(
          [&](NodeIndex hour) { return hour == at ? stamp : Hours(hour); });
      const std::string dropped = DroppedOf(graph, 365);
      EXPECT_TRUE(dropped == kRight || dropped == "[0, 1228) ")
          << stamp << " at " << at << ": " << dropped;
    }
  }
}

TEST(StampsTest, FewerWrongStampsThanAgreeDropNothing) {
  for (const std::int64_t years : {-50, -1, 1, 2, 130}) {
    for (const NodeIndex count : {2, 5, 10}) {
      const auto graph = Road([&](NodeIndex hour) {
        return Hours(hour + (hour >= 10'000 - count ? years * 8760 : 0));
      });
      // As many nodes more or fewer as are wrong.
      const auto dropped = DroppedOf(graph, 365);
      EXPECT_THAT(dropped, AnyOf(StartsWith("[0, 121"), StartsWith("[0, 122"),
                                 StartsWith("[0, 123")))
          << years << " years, " << count;
    }
  }
}

TEST(StampsTest, ALeapDropsNothingUntilItHasLasted) {
  const auto leapt = [](NodeIndex nodes) {
    return Road([nodes](NodeIndex hour) {
      return Hours(hour + (hour >= 10'000 - nodes ? 2 * 8760 : 0));
    });
  };
  // A hundred newest nodes, and eleven that agree.
  for (const NodeIndex nodes : {1, 11, 50, 100, 110}) {
    EXPECT_THAT(DroppedOf(leapt(nodes), 365), StartsWith("[0, 1")) << nodes;
  }
  EXPECT_EQ(DroppedOf(leapt(111), 365), "[0, 9889) ");
  EXPECT_EQ(DroppedOf(leapt(2000), 365), "[0, 8000) ");
}

TEST(StampsTest, ManySmallLeapsAreOneUntilTheyHaveLasted) {
  // 300 days at each twentieth of the last nodes.
  const auto leaping = [](NodeIndex nodes) {
    return Road([nodes](NodeIndex hour) {
      const NodeIndex since = std::max<NodeIndex>(0, hour - (10'000 - nodes));
      return Hours(hour + 300 * 24 * ((since + 19) / 20));
    });
  };
  EXPECT_THAT(DroppedOf(leaping(100), 365), StartsWith("[0, 1"));
  EXPECT_THAT(DroppedOf(leaping(300), 365), StartsWith("[0, 9"));
  // Forward by a little less than the age for a while, and back again.
  const auto swinging = Road([](NodeIndex hour) {
    return Hours(hour + (hour % 100 >= 50 ? 300 * 24 : 0));
  });
  EXPECT_THAT(DroppedOf(swinging, 365), StartsWith("[0, 1"));
}

TEST(StampsTest, StampsAheadOfTheClockAreNotBelievedHoweverLongTheyLast) {
  const auto graph = Road([](NodeIndex hour) {
    return Hours(hour + (hour >= 5000 ? 74 * 8760 : 0));
  });
  EXPECT_EQ(DroppedOf(graph, 365), "[0, 5000) ");
  EXPECT_EQ(DroppedOf(graph, 365, Hours(10'000)), "");
  // And none of all.
  EXPECT_EQ(DroppedOf(Road(Hours), 365, -Hours(1)), "");
}

TEST(StampsTest, WhatLiesBehindYoungPosesIsNotTooOld) {
  // The clock stood at 0 for a day, and for most of a year.
  for (const NodeIndex hours : {24, 7000}) {
    const auto graph = Road([hours](NodeIndex hour) {
      return 2000 <= hour && hour < 2000 + hours ? Hours(hour - 2000)
                                                 : Hours(hour);
    });
    EXPECT_EQ(DroppedOf(graph, 365), kRight) << hours;
  }
}

TEST(StampsTest, AClockThatGoesBackForGoodDropsOnByTheNewTime) {
  const auto graph = Road(
      [](NodeIndex hour) {
        return Hours(hour < 3000 ? hour + 9 * 8760 : hour);
      },
      14'000);
  EXPECT_EQ(DroppedOf(graph, 365), "");
  EXPECT_THAT(DroppedOf(Road([](NodeIndex hour) {
                          return Hours(hour < 3000 ? hour - 9 * 8760 : hour);
                        }),
                        365),
              "[0, 3000) ");
}

TEST(StampsTest, OneWrongPoseOfManyNodesHasNoMoreVotesThanOne) {
  // Poses 200 m apart, so that half of the last nodes lie near a wrong one.
  for (const NodeIndex wrong : {99, 98, 95}) {
    PoseGraph graph;
    const auto stamp = [wrong](NodeIndex pose) {
      return Hours(100 * pose + (pose == wrong ? 74 * 8760 : 0));
    };
    for (NodeIndex i = 0; i < 9901; ++i) {
      Node node = Road(Hours, 1).node(0);
      const NodeIndex pose = i / 100;
      node.sequence = static_cast<std::uint64_t>(pose) + 1;
      node.fraction = static_cast<double>(i % 100) / 100.0;
      node.stamp_ns = stamp(pose);
      if (i % 100 > 0) {
        *node.stamp_ns += (stamp(pose + 1) - stamp(pose)) / 100 * (i % 100);
      }
      node.travelled_meters = 2.0 * static_cast<double>(i);
      graph.AddNode(node, i == 0, std::nullopt);
    }
    const std::string dropped = DroppedOf(graph, 300);
    EXPECT_THAT(dropped, AnyOf("", StartsWith("[0, 1"))) << wrong;
  }
}

TEST(StampsTest, TooFewStampsDropNothing) {
  const auto some = [](NodeIndex each) {
    return Road([each](NodeIndex hour) {
      return hour % each == 0 ? Stamp(Hours(hour)) : std::nullopt;
    });
  };
  EXPECT_EQ(DroppedOf(some(10'000), 30), "");
  EXPECT_EQ(DroppedOf(some(1000), 30), "");
  EXPECT_THAT(DroppedOf(some(100), 30), HasSubstr("[0, 1) [100, 101)"));
  EXPECT_EQ(DroppedOf(Road([](NodeIndex) { return Stamp(); }), 1), "");
}

// What a watch sees after each of a graph's nodes.
std::vector<std::uint64_t> LeapsSeen(const PoseGraph& graph,
                                     NodeIndex newest_nodes) {
  LeapWatch watch(365 * kDay, newest_nodes);
  PoseGraph growing;
  std::vector<std::uint64_t> seen;
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    growing.AddNode(graph.node(i), i == 0, std::nullopt);
    watch.Extend(growing, {});
    const auto leap = watch.leap();
    seen.push_back(leap ? leap->sequence : 0);
    LeapWatch anew(365 * kDay, newest_nodes);
    anew.Extend(growing, {});
    EXPECT_EQ(anew.leap().has_value(), leap.has_value()) << i;
  }
  return seen;
}

TEST(LeapWatchTest, SeesALeapAtOnceAndWhileItIsAmongTheNewestNodes) {
  const auto graph = Road(
      [](NodeIndex hour) { return Hours(hour + (hour >= 500 ? 8761 : 0)); },
      1000);
  const auto seen = LeapsSeen(graph, 100);
  for (std::size_t i = 0; i < seen.size(); ++i) {
    EXPECT_EQ(seen[i], i >= 500 && i < 600 ? 501u : 0u) << i;
  }
}

TEST(LeapWatchTest, SeesNoneWhereThereIsNone) {
  for (const std::int64_t hours : {8759, -100'000}) {
    const auto graph = Road(
        [hours](NodeIndex hour) {
          return Hours(hour + (hour >= 500 ? hours : 0));
        },
        700);
    EXPECT_THAT(LeapsSeen(graph, 100), Each(0u)) << hours;
  }
  EXPECT_THAT(LeapsSeen(Road([](NodeIndex) { return Stamp(); }, 300), 100),
              Each(0u));
}

TEST(LeapWatchTest, SeesOneBetweenTwoPosesWithManyNodes) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < 1000; ++i) {
    Node node = Road(Hours, 1).node(0);
    node.sequence = i < 200 ? 1 : 2;
    node.stamp_ns = i < 200 ? 0 : Hours(20 * (i - 199));
    graph.AddNode(node, i == 0, std::nullopt);
  }
  const auto seen = LeapsSeen(graph, 100);
  EXPECT_EQ(seen[300], 0u);
  EXPECT_EQ(seen[999], 2u);
}

TEST(LeapWatchTest, NoLeapLeadsOverPosesThatWereDropped) {
  const auto graph = Road(
      [](NodeIndex hour) { return Hours(hour + (hour >= 500 ? 9000 : 0)); },
      510);
  DroppedStretch stretch;
  stretch.first_sequence = 501;
  stretch.last_sequence = 600;
  DroppedStretches dropped;
  dropped.Add(stretch, 500);
  LeapWatch watch(365 * kDay, 100);
  watch.Extend(graph, dropped);
  EXPECT_FALSE(watch.leap());
}

TEST(LeapWatchTest, StampsAtBothEndsOfTimeAreALeap) {
  const auto graph = Road(
      [](NodeIndex hour) {
        return hour < 5 ? std::numeric_limits<std::int64_t>::min()
                        : std::numeric_limits<std::int64_t>::max();
      },
      10);
  LeapWatch watch(365 * kDay, 100);
  watch.Extend(graph, {});
  ASSERT_TRUE(watch.leap());
  EXPECT_EQ(watch.leap()->nanoseconds,
            std::numeric_limits<std::int64_t>::max());
}

}  // namespace
}  // namespace revisit::core
