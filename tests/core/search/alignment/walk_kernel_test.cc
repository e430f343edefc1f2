#include "core/search/alignment/walk_kernel.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/shape_filter.h"
#include "tests/core/graphs.h"
#include "tests/core/vector_targets.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// A winding path of nodes with unrelated covariances.
PoseGraph RandomDrive(std::mt19937_64& random, NodeIndex size) {
  PoseGraph graph;
  Pose pose = RandomPose(random, 100.0);
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose = pose;
    node.covariance = RandomCovariance(random, 0.5);
    graph.AddNode(node, i == 0, std::nullopt);
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
    pose.z += Normal(random, 0.1);
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.4));
  }
  return graph;
}

std::vector<double> PosesOf(const PoseGraph& graph) {
  std::vector<double> poses;
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    const Pose pose = graph.pose(i);
    poses.insert(poses.end(), {pose.x, pose.y, pose.z, pose.heading});
  }
  return poses;
}

// How often each case has occurred in the trials.
struct WalksSeen {
  int walked_on = 0;
  int better = 0;
  int hopeless = 0;
  int at_road_end = 0;
  int stopped = 0;
  int no_numbers = 0;
};

template <int D>
StateVector<D> SeenBy(const Walkers& walkers, std::size_t i, const Pose& pose) {
  const double x = pose.x - walkers.at(Walkers::kX, i);
  const double y = pose.y - walkers.at(Walkers::kY, i);
  const double cosine = walkers.at(Walkers::kCosine, i);
  const double sine = walkers.at(Walkers::kSine, i);
  StateVector<D> seen = StateVector<D>::Zero();
  seen(0) = cosine * x + sine * y;
  seen(1) = cosine * y - sine * x;
  if (D == 4) seen(2) = pose.z - walkers.at(Walkers::kZ, i);
  seen(D - 1) = pose.heading - walkers.at(Walkers::kHeading, i);
  return seen;
}

// A walker somewhere in the graph that more or less keeps step next.
template <int D>
void AddWalker(std::mt19937_64& random, const PoseGraph& graph,
               const ShapeFilter<D>& filter, std::int64_t t, Walkers* walkers) {
  const std::size_t i = walkers->Add();
  const NodeIndex last_node = graph.size() - 1;
  const NodeIndex node = UniformInt(random, 0, static_cast<int>(last_node));
  const bool back = UniformInt(random, 0, 1) == 0;
  walkers->at(Walkers::kNode, i) = node;
  walkers->at(Walkers::kStride, i) = back ? -1 : 1;
  // One in five is where the road ends.
  walkers->at(Walkers::kLast, i) =
      UniformInt(random, 0, 4) == 0
          ? node
          : UniformInt(random, back ? 0 : static_cast<int>(node),
                       static_cast<int>(back ? node : last_node));
  walkers->at(Walkers::kEnd, i) = UniformInt(random, 0, 127);
  walkers->at(Walkers::kTrail, i) = UniformInt(random, 0, 1000);
  walkers->at(Walkers::kBestTrail, i) = UniformInt(random, 0, 1000);

  for (std::size_t r = 0; r < 4; ++r) {
    walkers->at(Walkers::kNow + r, i) = Normal(random, r < 2 ? 0.5 : 0.1);
    walkers->at(Walkers::kAtEnd + r, i) = Normal(random, 0.5);
    walkers->at(Walkers::kBestAtEnd + r, i) = Normal(random, 0.5);
  }
  const double ratio = Normal(random, 5.0);
  walkers->at(Walkers::kRatio, i) = ratio;
  walkers->at(Walkers::kSquared, i) = Uniform(random, 0.0, 50.0);
  walkers->at(Walkers::kBestRatio, i) = ratio + Normal(random, 4.0);
  walkers->at(Walkers::kBestSquared, i) = Uniform(random, 0.0, 50.0);
  walkers->at(Walkers::kBestSteps, i) = UniformInt(random, 0, 50);
  walkers->at(Walkers::kNeeded, i) =
      UniformInt(random, 0, 1) ? -std::numeric_limits<double>::infinity()
                               : ratio + Normal(random, 10.0);

  // The end is placed so that the next node is seen where the drift predicts
  // it, up to some straying.
  const NodeIndex next =
      std::clamp<NodeIndex>(node + (back ? -1 : 1), 0, last_node);
  const Pose pose = graph.pose(next);
  // Scratch that may be left from the step before must not matter.
  walkers->at(Walkers::kThere, i) = pose.x;
  walkers->at(Walkers::kThere + 1, i) = pose.y;
  walkers->at(Walkers::kThere + 2, i) = pose.z;
  walkers->at(Walkers::kThere + 3, i) = pose.heading;
  const WalkStep step = filter.Kernel(t);
  const double turn = walkers->at(Walkers::kNow + D - 1, i);
  const double straying =
      UniformInt(random, 0, 5) == 0 ? 10.0 : Uniform(random, 0.0, 1.0);
  double seen[4] = {};
  for (std::size_t r = 0; r < D; ++r) {
    seen[r] = step.path[r] - walkers->at(Walkers::kNow + r, i) +
              Normal(random, r + 1 == D ? 0.1 * straying : straying);
  }
  seen[0] += step.step_y * turn;
  seen[1] -= step.step_x * turn;
  // Headings are seen from the end's own heading, up to whole turns; positions
  // are seen in the axes of the heading in which the end is walked from.
  const double whole_turns = 2.0 * kPi * UniformInt(random, -2, 2);
  const double heading = pose.heading - seen[D - 1];
  const double cosine = std::cos(heading);
  const double sine = std::sin(heading);
  walkers->at(Walkers::kHeading, i) = heading + whole_turns;
  walkers->at(Walkers::kCosine, i) = cosine;
  walkers->at(Walkers::kSine, i) = sine;
  walkers->at(Walkers::kX, i) = pose.x - (cosine * seen[0] - sine * seen[1]);
  walkers->at(Walkers::kY, i) = pose.y - (sine * seen[0] + cosine * seen[1]);
  walkers->at(Walkers::kZ, i) = pose.z - seen[2];
  if (UniformInt(random, 0, 49) == 0) {
    walkers->at(Walkers::kX, i) = UniformInt(random, 0, 1)
                                      ? std::numeric_limits<double>::quiet_NaN()
                                      : std::numeric_limits<double>::infinity();
  }
}

// Compares bit for bit, except for the kernel's scratch.
void ExpectUntouched(const Walkers& before, const Walkers& after,
                     std::size_t i) {
  for (std::size_t c = 0; c < Walkers::kThere; ++c) {
    const double was = before.at(c, i);
    const double is = after.at(c, i);
    EXPECT_TRUE(is == was || (std::isnan(is) && std::isnan(was)))
        << "column " << c << " is " << is << " and was " << was;
  }
  for (std::size_t c = 0; c < Walkers::kIndices; ++c) {
    EXPECT_EQ(after.at(static_cast<Walkers::Index>(c), i),
              before.at(static_cast<Walkers::Index>(c), i))
        << "index " << c;
  }
}

template <int D>
void ExpectWhatTheFilterSays(std::mt19937_64& random, WalksSeen* seen) {
  const PoseGraph graph = RandomDrive(random, UniformInt(random, 30, 200));
  const auto poses = PosesOf(graph);
  const std::int64_t steps = UniformInt(random, 2, 25);
  ShapeModel model;
  model.tolerance = {Uniform(random, 0.2, 2.0), Uniform(random, 0.02, 0.2)};
  const ShapeFilter<D> filter(
      {graph,
       UniformInt(random, static_cast<int>(steps),
                  static_cast<int>(graph.size()) - 1),
       steps},
      static_cast<CorrelationModel>(UniformInt(random, 0, 1)), model,
      PlaceTolerance{}, 2.0, 1.0);
  const std::int64_t t =
      UniformInt(random, 1, static_cast<int>(filter.size()) - 1);
  WalkStep step = filter.Kernel(t);
  EXPECT_EQ(step.number, static_cast<double>(t));
  step.settled = Uniform(random, 5.0, 16.0);
  step.to_come = Uniform(random, 0.0, 10.0);

  Walkers walkers;
  const int count = UniformInt(random, 0, 150);
  const int others = UniformInt(random, 0, 9);
  for (int k = 0; k < count + others; ++k) {
    AddWalker<D>(random, graph, filter, t, &walkers);
  }
  const Walkers before = walkers;
  std::vector<Unsettled> unsettled = {{7, true, 7.0}};
  WalkOn(D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial, step,
         poses.data(), static_cast<std::size_t>(count), &walkers, &unsettled);
  ASSERT_EQ(walkers.size(), before.size());

  auto left = unsettled.begin();
  for (std::size_t i = 0; i < before.size(); ++i) {
    SCOPED_TRACE(::testing::Message()
                 << "walker " << i << " of " << count << " and " << others);
    if (i >= static_cast<std::size_t>(count)) {
      ExpectUntouched(before, walkers, i);
      continue;
    }
    const bool is_left = left != unsettled.end() && left->walker == i;
    const NodeIndex node = before.at(Walkers::kNode, i);
    if (node == before.at(Walkers::kLast, i)) {
      ASSERT_TRUE(is_left);
      EXPECT_FALSE(left->hopeless);
      EXPECT_EQ(left->squared_innovation,
                std::numeric_limits<double>::infinity());
      ExpectUntouched(before, walkers, i);
      ++left;
      ++seen->at_road_end;
      continue;
    }
    const NodeIndex next = node + before.at(Walkers::kStride, i);
    typename ShapeFilter<D>::Drift drift;
    for (int r = 0; r < D; ++r) {
      const auto row = static_cast<std::size_t>(r);
      drift.now(r) = before.at(Walkers::kNow + row, i);
      drift.at_end(r) = before.at(Walkers::kAtEnd + row, i);
    }
    const auto evidence =
        filter.Advance(t, SeenBy<D>(before, i, graph.pose(next)), &drift);
    const double squared = evidence.squared_innovation;
    const auto near = [squared](double actual, double expected) {
      EXPECT_NEAR(actual, expected,
                  1e-9 * std::max({1.0, std::abs(expected), squared}));
    };
    if (!(squared <= step.settled)) {
      ASSERT_TRUE(is_left) << squared;
      EXPECT_FALSE(left->hopeless);
      if (std::isfinite(squared)) {
        near(left->squared_innovation, squared);
      } else {
        EXPECT_FALSE(std::isfinite(left->squared_innovation));
        ++seen->no_numbers;
      }
      ExpectUntouched(before, walkers, i);
      ++left;
      ++seen->stopped;
      continue;
    }
    ++seen->walked_on;
    EXPECT_EQ(walkers.at(Walkers::kNode, i), next);
    const double ratio =
        before.at(Walkers::kRatio, i) + evidence.log_likelihood_ratio;
    const double squares = before.at(Walkers::kSquared, i) + squared;
    near(walkers.at(Walkers::kRatio, i), ratio);
    near(walkers.at(Walkers::kSquared, i), squares);
    const bool better = ratio > before.at(Walkers::kBestRatio, i);
    seen->better += better;
    const auto best = [&](std::size_t column, double now) {
      near(walkers.at(column, i), better ? now : before.at(column, i));
    };
    best(Walkers::kBestRatio, ratio);
    best(Walkers::kBestSquared, squares);
    best(Walkers::kBestSteps, static_cast<double>(t));
    for (int r = 0; r < D; ++r) {
      const auto row = static_cast<std::size_t>(r);
      near(walkers.at(Walkers::kNow + row, i), drift.now(r));
      near(walkers.at(Walkers::kAtEnd + row, i), drift.at_end(r));
      best(Walkers::kBestAtEnd + row, drift.at_end(r));
    }
    for (const std::size_t c :
         {std::size_t{Walkers::kX}, std::size_t{Walkers::kY},
          std::size_t{Walkers::kZ}, std::size_t{Walkers::kHeading},
          std::size_t{Walkers::kCosine}, std::size_t{Walkers::kSine},
          std::size_t{Walkers::kNeeded}}) {
      EXPECT_EQ(walkers.at(c, i), before.at(c, i));
    }
    const double most = ratio + step.to_come;
    const bool hopeless =
        !(most > std::max(ratio, before.at(Walkers::kBestRatio, i))) ||
        !(most + 0.25 * squares >= before.at(Walkers::kNeeded, i));
    ASSERT_EQ(is_left, hopeless);
    if (!is_left) continue;
    EXPECT_TRUE(left->hopeless);
    ++left;
    ++seen->hopeless;
  }
  EXPECT_EQ(left, unsettled.end());
}

TEST(WalkOnTest, DoesWhatTheFilterDoesForEachThatKeepsStepAndSaysWhoDoesNot) {
  std::mt19937_64 random = SeededRandom();
  WalksSeen seen;
  ForEachVectorTarget([&] {
    for (int trial = 0; trial < 100 && !::testing::Test::HasFailure();
         ++trial) {
      SCOPED_TRACE(trial);
      ExpectWhatTheFilterSays<3>(random, &seen);
      ExpectWhatTheFilterSays<4>(random, &seen);
    }
  });
  EXPECT_GT(seen.walked_on, 1000);
  EXPECT_GT(seen.better, 100);
  EXPECT_GT(seen.hopeless, 100);
  EXPECT_GT(seen.at_road_end, 1000);
  EXPECT_GT(seen.stopped, 1000);
  EXPECT_GT(seen.no_numbers, 10);
}

TEST(WalkOnTest, MachinesAgreeToTheLastBit) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomDrive(random, 120);
  const auto poses = PosesOf(graph);
  const ShapeFilter<4> filter({graph, 119, 20},
                              CorrelationModel::kDeadReckoning, ShapeModel{},
                              PlaceTolerance{}, 2.0, 1.0);
  Walkers start;
  for (int k = 0; k < 61; ++k) {
    AddWalker<4>(random, graph, filter, 7, &start);
  }
  WalkStep step = filter.Kernel(7);
  step.settled = 9.2;
  step.to_come = 2.0;
  for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
    std::optional<Walkers> first;
    ForEachVectorTarget([&] {
      Walkers walkers = start;
      std::vector<Unsettled> unsettled;
      WalkOn(space, step, poses.data(), 61, &walkers, &unsettled);
      if (!first) first = walkers;
      for (std::size_t i = 0; i < 61; ++i) ExpectUntouched(*first, walkers, i);
    });
  }
}

TEST(WalkersTest, KeepWhatTheyHoldAsTheyGrowAndGo) {
  Walkers walkers;
  for (std::size_t i = 0; i < 200; ++i) {
    ASSERT_EQ(walkers.Add(), i);
    for (std::size_t c = 0; c < Walkers::kColumns; ++c) {
      walkers.at(c, i) = static_cast<double>(1000 * c + i);
    }
    for (std::size_t c = 0; c < Walkers::kIndices; ++c) {
      walkers.at(static_cast<Walkers::Index>(c), i) =
          static_cast<std::int64_t>(1000 * c + i);
    }
  }
  const auto expect = [&walkers](std::size_t i, std::size_t was) {
    for (std::size_t c = 0; c < Walkers::kColumns; ++c) {
      EXPECT_EQ(walkers.at(c, i), static_cast<double>(1000 * c + was));
      EXPECT_EQ(walkers.column(c)[i], walkers.at(c, i));
    }
    for (std::size_t c = 0; c < Walkers::kIndices; ++c) {
      EXPECT_EQ(walkers.at(static_cast<Walkers::Index>(c), i),
                static_cast<std::int64_t>(1000 * c + was));
    }
  };
  expect(0, 0);
  expect(77, 77);
  walkers.Copy(5, 6);
  expect(6, 5);
  walkers.Remove(77);
  EXPECT_EQ(walkers.size(), 199u);
  expect(77, 199);
  expect(78, 78);
  walkers.Remove(198);
  EXPECT_EQ(walkers.size(), 198u);
  expect(197, 197);
}

}  // namespace
}  // namespace revisit::core
