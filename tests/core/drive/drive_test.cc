#include "core/drive/drive.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

// Laps of a 400 m by 200 m rectangle with a pose every metre, estimated without
// error.
std::vector<PoseSample> Laps(double meters) {
  std::vector<Pose> path;
  for (double s = 0.0; s <= meters; s += 1.0) {
    const double along = std::fmod(s, 1200.0);
    if (along < 400.0) {
      path.push_back({along, 0.0, 0.0, 0.0});
    } else if (along < 600.0) {
      path.push_back({400.0, along - 400.0, 0.0, 0.5 * kPi});
    } else if (along < 1000.0) {
      path.push_back({1000.0 - along, 200.0, 0.0, kPi});
    } else {
      path.push_back({0.0, 1200.0 - along, 0.0, -0.5 * kPi});
    }
  }
  return oracle::WithCovariances(path, {});
}

Drive Driven(double meters, const DriveSettings& settings = {}) {
  Drive drive(settings);
  drive.Append(Laps(meters), 1);
  return drive;
}

TEST(DriveTest, RecognisesTheSecondLap) {
  const Drive drive = Driven(1700.0);
  const auto set = Search(&drive).AtEnd(drive.settings().search, nullptr);
  ASSERT_TRUE(set.ok());
  ASSERT_FALSE(set->candidates.empty());
  EXPECT_EQ(set->empty_reason, EmptyReason::kNotEmpty);
  EXPECT_EQ(set->query, drive.graph().size() - 1);
  EXPECT_EQ(set->nodes_considered + set->nodes_pruned,
            drive.graph().size() - 75);
  const Candidate& best = set->candidates[0];
  EXPECT_EQ(best.rank, 1);
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kAccepted);
  EXPECT_NEAR(drive.graph().node(best.matched).travelled_meters, 500.0, 2.0);
  ASSERT_EQ(best.path.size(), 150u);
  EXPECT_EQ(best.path.back().first, *set->query);
  EXPECT_EQ(best.path.back().second, best.matched);
  EXPECT_EQ(best.path.front().first, *set->query - 149);
  for (std::size_t i = 1; i < set->candidates.size(); ++i) {
    EXPECT_LE(set->candidates[i].score, set->candidates[i - 1].score);
    EXPECT_EQ(set->candidates[i].rank, static_cast<int>(i) + 1);
  }
}

TEST(DriveTest, TheAnswerAtANodeDoesNotDependOnWhatCameAfter) {
  const Drive then = Driven(1700.0);
  const Drive later = Driven(2600.0);
  const NodeIndex query = then.graph().size() - 1;
  const SearchOptions options;
  const auto a = Search(&then).At(query, options, nullptr);
  const auto b = Search(&later).At(query, options, nullptr);
  ASSERT_EQ(a->candidates.size(), b->candidates.size());
  for (std::size_t i = 0; i < a->candidates.size(); ++i) {
    EXPECT_EQ(a->candidates[i].score, b->candidates[i].score);
    EXPECT_EQ(a->candidates[i].path, b->candidates[i].path);
  }
}

TEST(DriveTest, BatchesDoNotChangeTheGraph) {
  const std::vector<PoseSample> samples = Laps(900.0);
  Drive whole({});
  const AppendResult at_once = whole.Append(samples, 1);
  Drive pieces({});
  std::mt19937_64 random = SeededRandom();
  std::vector<NodeIndex> checks;
  std::uint64_t revision = 0;
  for (std::size_t i = 0; i < samples.size();) {
    const std::size_t n =
        std::min(samples.size() - i,
                 static_cast<std::size_t>(UniformInt(random, 1, 40)));
    const AppendResult result =
        pieces.Append({samples.begin() + static_cast<std::ptrdiff_t>(i),
                       samples.begin() + static_cast<std::ptrdiff_t>(i + n)},
                      ++revision);
    checks.insert(checks.end(), result.checks_due.begin(),
                  result.checks_due.end());
    i += n;
  }
  EXPECT_EQ(checks, at_once.checks_due);
  ASSERT_EQ(pieces.graph().size(), whole.graph().size());
  for (NodeIndex i = 0; i < whole.graph().size(); ++i) {
    EXPECT_EQ(pieces.graph().node(i).pose.x, whole.graph().node(i).pose.x);
    EXPECT_EQ(pieces.graph().node(i).covariance.upper,
              whole.graph().node(i).covariance.upper);
  }
}

TEST(DriveTest, ChecksFallDueFromTwoSequenceLengthsOn) {
  Drive drive({});
  EXPECT_THAT(drive.Append(Laps(460.0), 1).checks_due,
              ElementsAre(150, 175, 200, 225));
}

TEST(DriveTest, ChecksFollowChangedSettings) {
  Drive drive({});
  const std::vector<PoseSample> samples = Laps(700.0);
  drive.Append({samples.begin(), samples.begin() + 331}, 1);  // 330 m
  DriveSettings settings;
  settings.check_interval_meters = 100.0;
  EXPECT_TRUE(drive.ChangeSettings(settings, 2).ok());
  EXPECT_THAT(
      drive.Append({samples.begin() + 331, samples.end()}, 3).checks_due,
      ElementsAre(200, 250, 300, 350));
  EXPECT_EQ(drive.revision(), 3u);
}

TEST(DriveTest, FindsTheChecksThatFellDueAtAnyTime) {
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 20; ++round) {
    DriveSettings settings;
    settings.check_interval_meters = UniformInt(random, 2, 90);
    Drive drive(settings);
    const std::vector<PoseSample> samples = Laps(UniformInt(random, 100, 1200));
    const std::vector<NodeIndex> due = drive.Append(samples, 1).checks_due;
    std::vector<NodeIndex> found;
    std::uint64_t after = 0;
    while (const std::optional<DueCheck> next = drive.NextCheck(after)) {
      EXPECT_GT(next->sequence, after);
      EXPECT_LE(next->sequence, drive.last_sequence());
      EXPECT_EQ(drive.ChecksBehind(after),
                static_cast<std::int64_t>(due.size() - found.size()));
      found.push_back(next->node);
      // Every pose from here to the check leads to the same one.
      const auto between =
          after + static_cast<std::uint64_t>(UniformInt(
                      random, 0, static_cast<int>(next->sequence - after - 1)));
      EXPECT_EQ(drive.NextCheck(between)->sequence, next->sequence);
      after = next->sequence;
    }
    EXPECT_EQ(found, due);
    EXPECT_EQ(drive.ChecksBehind(after), 0);
  }
}

TEST(DriveTest, FindsOneCheckAPoseWherePosesLieFarApart) {
  DriveSettings settings;
  settings.check_interval_meters = 10.0;
  settings.max_step_meters = 100.0;
  Drive drive(settings);
  std::vector<PoseSample> samples;
  for (std::uint64_t i = 1; i <= 20; ++i) {
    PoseSample& sample = samples.emplace_back(Laps(1.0).front());
    sample.sequence = i;
    sample.pose.x = 35.0 * static_cast<double>(i);
    sample.pose.y = 0.0;
  }
  drive.Append(samples, 1);
  std::uint64_t after = 0;
  // 300 m are two sequence lengths, which the tenth pose is the first to pass.
  for (std::uint64_t sequence = 10; sequence <= 20; ++sequence) {
    const std::optional<DueCheck> next = drive.NextCheck(after);
    ASSERT_TRUE(next.has_value());
    EXPECT_EQ(next->sequence, sequence);
    EXPECT_EQ(next->node, *drive.graph().NodeAtOrBefore(sequence));
    after = next->sequence;
  }
  EXPECT_EQ(drive.NextCheck(after), std::nullopt);
}

TEST(DriveTest, SaysWhyAnAnswerIsEmpty) {
  const SearchOptions options;
  const Drive nothing({});
  auto set = Search(&nothing).AtEnd(options, nullptr);
  EXPECT_EQ(set->empty_reason, EmptyReason::kPathTooShort);
  EXPECT_EQ(set->query, std::nullopt);

  const auto reason = [](double meters, const SearchOptions& asked) {
    const Drive drive = Driven(meters);
    return Search(&drive).AtEnd(asked, nullptr)->empty_reason;
  };
  EXPECT_EQ(reason(140.0, options), EmptyReason::kPathTooShort);
  // 75 nodes, 148 m: a sequence with nothing before it.
  EXPECT_EQ(reason(148.0, options), EmptyReason::kNoHistory);

  SearchOptions separated;
  separated.candidate_separation_meters = 500.0;
  EXPECT_EQ(reason(400.0, separated), EmptyReason::kAllSuppressed);

  // A history of a single node has no path of 75.
  SearchOptions composite;
  composite.alignment = AlignmentKind::kComposite;
  EXPECT_EQ(reason(150.0, composite), EmptyReason::kNoAlignment);
}

TEST(DriveTest, ThePathStartsAnewAfterAJump) {
  std::vector<PoseSample> samples = Laps(700.0);
  for (std::size_t i = 600; i < samples.size(); ++i) {
    samples[i].pose.y += 5000.0;
  }
  Drive drive({});
  const AppendResult result = drive.Append(samples, 1);
  ASSERT_EQ(result.jumps.size(), 1u);
  EXPECT_EQ(result.jumps[0].sequence, 601u);
  EXPECT_EQ(Search(&drive).AtEnd({}, nullptr)->empty_reason,
            EmptyReason::kPathTooShort);
}

TEST(DriveTest, StopsWhenTold) {
  const Drive drive = Driven(1300.0);
  const auto set = Search(&drive).AtEnd({}, [] { return true; });
  EXPECT_EQ(set.status().code(), absl::StatusCode::kCancelled);
}

TEST(DriveTest, LoopClosuresBecomeEdgesBetweenTheNodesAtOrBefore) {
  Drive drive = Driven(1300.0);
  drive.AddLoopClosure(1212, 10, 2);
  // Poses 1212 and 10 are 1211 m and 9 m along; the nodes before them, 1210 and
  // 8.
  EXPECT_THAT(drive.graph().LoopEdges(),
              ElementsAre(std::make_pair(NodeIndex{4}, NodeIndex{605})));
  EXPECT_EQ(drive.revision(), 2u);
  drive.RemoveLoopClosure(1212, 10, 3);
  EXPECT_THAT(drive.graph().LoopEdges(), IsEmpty());
  drive.AddLoopClosure(11, 12, 4);  // Both at node 5.
  EXPECT_THAT(drive.graph().LoopEdges(), IsEmpty());
  EXPECT_EQ(drive.revision(), 4u);
}

TEST(DriveTest, OptionsOverrideTheVehicles) {
  const Drive drive = Driven(1700.0);
  SearchOptions options;
  options.max_candidates = 2;
  options.sequence_length_meters = 60.0;
  options.correlation_model = CorrelationModel::kIndependent;
  options.gate_probability = 0.5;
  const auto set = Search(&drive).AtEnd(options, nullptr);
  ASSERT_EQ(set->candidates.size(), 2u);
  EXPECT_EQ(set->candidates[0].path.size(), 30u);
  EXPECT_NEAR(set->candidates[0].difference->gate.threshold, 2.36597, 1e-5);
}

TEST(DriveTest, PlanarAndSpatialAgreeOnAFlatRoad) {
  DriveSettings settings;
  settings.state_space = StateSpace::kSpatial;
  std::vector<PoseSample> samples = Laps(1700.0);
  for (PoseSample& sample : samples) sample.covariance(2, 2) = 1.0;
  Drive spatial(settings);
  spatial.Append(samples, 1);
  const Drive planar = Driven(1700.0);
  const auto a = Search(&spatial).AtEnd({}, nullptr);
  const auto b = Search(&planar).AtEnd({}, nullptr);
  EXPECT_EQ(a->candidates[0].matched, b->candidates[0].matched);
  EXPECT_EQ(a->candidates[0].difference->gate.degrees_of_freedom, 4);
  EXPECT_NEAR(a->candidates[0].difference->gate.squared_mahalanobis,
              b->candidates[0].difference->gate.squared_mahalanobis, 1e-9);
}

}  // namespace
}  // namespace revisit::core
