#include "core/search/candidates/value.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <memory>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/core/drive/wandering.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/oracle/joint_errors.h"
#include "tests/oracle/wide_state.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// Random closures between nodes, of which some are measured.
void CloseAnything(std::mt19937_64& random, int closures, Drive* drive) {
  const PoseGraph& graph = drive->graph();
  const auto last = static_cast<int>(graph.size()) - 1;
  for (int k = 0; k < closures; ++k) {
    const NodeIndex a = UniformInt(random, 0, last);
    const NodeIndex b = UniformInt(random, 0, last);
    const NodeIndex query = std::max(a, b);
    const NodeIndex matched = std::min(a, b);
    std::shared_ptr<const MeasuredLoop> measured;
    if (UniformInt(random, 0, 1)) {
      measured = RandomMeasurement(random, EstimateAt(graph, query),
                                   EstimateAt(graph, matched), 0.5);
    }
    const std::uint64_t later = PoseAt(graph, query);
    const std::uint64_t earlier = PoseAt(graph, matched);
    if (later == 0 || later > drive->last_sequence() || earlier == 0) continue;
    drive->AddLoopClosure(later, earlier, drive->revision() + 1, measured);
  }
}

void Show(const PoseGraph& graph, const ConfirmedLoop& loop, int dimensions,
          oracle::JointErrors* errors) {
  if (loop.measured == nullptr) {
    errors->Show(loop.query, loop.matched,
                 oracle::WideMatrix::Identity(dimensions, dimensions),
                 oracle::WideDiagonal(5.0, 0.15, dimensions));
    return;
  }
  ASSERT_EQ(loop.measured->query.pose.x, graph.pose(loop.query).x);
  const oracle::WideClosure closure =
      oracle::WideMeasured(*loop.measured, dimensions);
  errors->Show(loop.query, loop.matched, closure.lever, closure.tolerance);
}

template <int D>
void ExpectWhatAllErrorsLose(std::mt19937_64& random) {
  DriveSettings settings;
  settings.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  settings.apply_inflation = UniformInt(random, 0, 1) == 0;
  settings.search.use_belief = !settings.apply_inflation;
  Drive drive(settings);
  drive.Append(WanderingSamples<D>(random, UniformInt(random, 5, 45)), 1);
  CloseAnything(random, UniformInt(random, 0, 6), &drive);
  const PoseGraph& graph = drive.graph();
  const auto last = static_cast<int>(graph.size()) - 1;
  const NodeIndex query = UniformInt(random, 0, last);
  const NodeIndex matched = UniformInt(random, 0, last);
  const double inflation = drive.SimilarityOf(settings.search).inflation;
  oracle::JointErrors errors(graph, D, inflation);

  // Those with their later nodes nearest to the query, before it and behind.
  const ConfirmedLoop* before = nullptr;
  const ConfirmedLoop* behind = nullptr;
  const auto end = [](const ConfirmedLoop* loop) {
    return std::max(loop->query, loop->matched);
  };
  for (const ConfirmedPair& pair : drive.confirmed()) {
    const ConfirmedLoop* const loop = &pair.loop;
    if (end(loop) <= query) {
      if (before == nullptr || end(loop) >= end(before)) before = loop;
    } else if (behind == nullptr || end(loop) < end(behind)) {
      behind = loop;
    }
  }
  if (before != nullptr) Show(graph, *before, D, &errors);
  if (behind != nullptr) Show(graph, *behind, D, &errors);
  const oracle::Wide known = errors.MeanPositionVariance();
  errors.Show(query, matched, oracle::WideMatrix::Identity(D, D),
              oracle::WideDiagonal(5.0, 0.15, D));
  const auto wanted =
      static_cast<double>(known - errors.MeanPositionVariance());
  EXPECT_NEAR(VarianceReductions(drive).Of(query, matched), wanted,
              1e-8 * static_cast<double>(known))
      << query << " " << matched << " of " << graph.size() << ", "
      << drive.confirmed().size() << " closures";
}

TEST(VarianceReductionsTest, IsWhatTheErrorsOfAllNodesLoseInThePlane) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) ExpectWhatAllErrorsLose<3>(random);
}

TEST(VarianceReductionsTest, IsWhatTheErrorsOfAllNodesLoseInSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) ExpectWhatAllErrorsLose<4>(random);
}

TEST(VarianceReductionsTest, AreTheSameHoweverManyPairsWereAskedAboutBefore) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 20; ++trial) {
    DriveSettings settings;
    settings.state_space =
        trial % 2 == 0 ? StateSpace::kPlanar : StateSpace::kSpatial;
    Drive drive(settings);
    drive.Append(WanderingSamples<4>(random, UniformInt(random, 5, 400)), 1);
    CloseAnything(random, 6, &drive);
    const auto last = static_cast<int>(drive.graph().size()) - 1;
    VarianceReductions reductions(drive);
    NodeIndex query = 0;
    for (int k = 0; k < 40; ++k) {
      if (k % 3 == 0) query = UniformInt(random, 0, last);
      const NodeIndex matched = UniformInt(random, 0, last);
      EXPECT_EQ(reductions.Of(query, matched),
                VarianceReductions(drive).Of(query, matched))
          << query << " " << matched;
    }
  }
}

// A ring of some 1150 m, driven three times by a poor odometer.
struct Laps {
  Laps() : drive(DriveSettings{}) {
    oracle::Noise noise;
    noise.along_meters = 0.5;
    noise.across_meters = 0.2;
    noise.heading_radians = 0.01;
    drive.Append(oracle::WithCovariances(Ring(3450.0), noise), 1);
  }
  // The node nearest to this one a lap before.
  NodeIndex LapBefore(NodeIndex node) const {
    NodeIndex nearest = node - 575 - 50;
    for (NodeIndex i = nearest; i < node - 575 + 50; ++i) {
      if (Apart(i, node) < Apart(nearest, node)) nearest = i;
    }
    return nearest;
  }
  double Apart(NodeIndex a, NodeIndex b) const {
    return Distance(drive.graph().pose(a), drive.graph().pose(b),
                    StateSpace::kPlanar);
  }
  double Value(NodeIndex query, NodeIndex matched) const {
    return VarianceReductions(drive).Of(query, matched);
  }
  void Confirm(NodeIndex query, NodeIndex matched) {
    drive.AddLoopClosure(PoseAt(drive.graph(), query),
                         PoseAt(drive.graph(), matched), drive.revision() + 1);
  }

  Drive drive;
};

TEST(VarianceReductionsTest, LoopsBackToTheStartAreWorthMoreThanRecentOnes) {
  const Laps laps;
  const NodeIndex query = laps.drive.graph().size() - 1;
  const NodeIndex recent = laps.LapBefore(query);
  const NodeIndex first = laps.LapBefore(recent);
  std::cout << laps.Value(query, first) << " m^2, " << laps.Value(query, recent)
            << " m^2\n";
  EXPECT_GT(laps.Value(query, first), 1.5 * laps.Value(query, recent));
}

TEST(VarianceReductionsTest, PlacesThatWereJustTiedAreWorthNextToNothing) {
  Laps laps;
  const NodeIndex query = 1000;
  const NodeIndex matched = laps.LapBefore(query);
  const double before = laps.Value(query, matched);
  laps.Confirm(query - 10, laps.LapBefore(query - 10));
  const double between = laps.Value(query, matched);
  laps.Confirm(query + 10, laps.LapBefore(query + 10));
  const double tied = laps.Value(query, matched);
  std::cout << before << " m^2, " << between << " m^2, " << tied << " m^2\n";
  EXPECT_LT(between, 0.1 * before);
  EXPECT_LT(tied, between);
  EXPECT_GE(tied, 0.0);
}

TEST(VarianceReductionsTest, OfALongDriveTheMeanOverSomeNodesIsThatOverAll) {
  const Laps laps;
  const PoseGraph& graph = laps.drive.graph();
  ASSERT_GT(graph.size(), 4 * 256);
  const NodeIndex query = graph.size() - 1;
  const NodeIndex matched = laps.LapBefore(query);
  // X_i of every node by itself.
  StateMatrix<3> gamma = DifferenceCovariance<3>(
      graph, Correlation(CorrelationModel::kDeadReckoning), query, matched);
  AddTolerance<3>(kConfirmedTolerance, &gamma);
  double sum = 0.0;
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    const Correlation correlation(CorrelationModel::kDeadReckoning);
    const StateMatrix<3> x = CrossCovariance<3>(graph, correlation, i, query) -
                             CrossCovariance<3>(graph, correlation, i, matched);
    const StateMatrix<3> lost = x * gamma.inverse() * x.transpose();
    sum += lost(0, 0) + lost(1, 1);
  }
  const double all = sum / static_cast<double>(graph.size());
  EXPECT_NEAR(laps.Value(query, matched), all, 0.01 * all);
}

TEST(VarianceReductionsTest, IsNothingWhereClosuresShowNoDrift) {
  for (const CorrelationModel model :
       {CorrelationModel::kIndependent, CorrelationModel::kCorrelatedFixes}) {
    DriveSettings settings;
    settings.search.correlation_model = model;
    Drive drive(settings);
    drive.Append(WithDeviations(Ring(1300.0), 3.0, 0.05), 1);
    EXPECT_EQ(VarianceReductions(drive).Of(600, 25), 0.0);
  }
}

TEST(VarianceReductionsTest, IsNothingBetweenTwoRecordings) {
  std::vector<PoseSample> samples =
      oracle::WithCovariances(Ring(1300.0), oracle::Noise{});
  samples[400].recording_start = std::make_shared<const RecordingStart>();
  Drive drive(DriveSettings{});
  drive.Append(samples, 1);
  ASSERT_EQ(drive.recordings().size(), 2u);
  EXPECT_EQ(VarianceReductions(drive).Of(600, 25), 0.0);
  EXPECT_GT(VarianceReductions(drive).Of(600, 250), 0.0);
}

TEST(VarianceReductionsTest, IsANumberWhateverIsClaimed) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) {
    DriveSettings settings;
    settings.state_space =
        trial % 2 == 0 ? StateSpace::kPlanar : StateSpace::kSpatial;
    Drive drive(settings);
    std::vector<PoseSample> samples = WanderingSamples<4>(random, 40);
    const double extent = std::pow(10.0, Uniform(random, 0.0, 8.0));
    for (PoseSample& sample : samples) {
      sample.pose.x += extent;
      if (UniformInt(random, 0, 9) == 0) sample.pose.x = -extent;
      if (UniformInt(random, 0, 3) == 0) {
        sample.covariance = RandomCovariance(
            random, std::pow(10.0, Uniform(random, -9.0, 8.0)));
      }
    }
    drive.Append(samples, 1);
    CloseAnything(random, 3, &drive);
    const auto last = static_cast<int>(drive.graph().size()) - 1;
    for (int k = 0; k < 20; ++k) {
      const double value = VarianceReductions(drive).Of(
          UniformInt(random, 0, last), UniformInt(random, 0, last));
      EXPECT_TRUE(std::isfinite(value)) << trial;
      EXPECT_GE(value, 0.0) << trial;
    }
  }
}

}  // namespace
}  // namespace revisit::core
