#include "core/drive/suspects.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iostream>
#include <memory>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "core/settings.h"
#include "tests/core/drive/closed_drives.h"
#include "tests/core/drive/drives.h"
#include "tests/core/drive/wandering.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/oracle/plain_suspects.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

class WrongLoopsTest
    : public ::testing::TestWithParam<std::pair<WrongLoops, bool>> {};

TEST_P(WrongLoopsTest, AreSuspectedAndRightOnesAreNot) {
  const auto [wrong, measured] = GetParam();
  std::mt19937_64 random = SeededRandom();
  SuspectScore score;
  for (int trial = 0; trial < 12; ++trial) {
    const ClosedDrive closed =
        RandomClosedDrive(DriveSettings(), 4000, wrong, measured, random);
    const std::vector<Suspect> suspects = FindSuspects(closed.drive);
    for (const Suspect& suspect : suspects) {
      EXPECT_EQ(suspect.occurrence, 0u);
      EXPECT_LT(suspect.p_value, kSuspectProbability);
    }
    score.Add(closed, suspects);
  }
  std::cout << (measured ? "measured" : "unmeasured") << ": recall "
            << score.recall() << " of " << score.wrong << ", "
            << score.right_share() << " of " << score.right
            << " right ones suspected\n";
  EXPECT_GT(score.wrong, 100);
  EXPECT_GE(score.recall(), 0.9);
  EXPECT_LE(score.right_share(), 0.02);
}

INSTANTIATE_TEST_SUITE_P(
    SuspectsTest, WrongLoopsTest,
    ::testing::Values(std::pair(WrongLoops::kAnywhere, false),
                      std::pair(WrongLoops::kNear, false),
                      std::pair(WrongLoops::kAnywhere, true),
                      std::pair(WrongLoops::kNear, true)));

// A closure in the second half of a wandering drive, at what its estimate says,
// or off by metres.
template <int D>
void CloseAtRandom(std::mt19937_64& random, NodeIndex query, Drive* drive) {
  const PoseGraph& graph = drive->graph();
  const NodeIndex matched = UniformInt(random, 0, static_cast<int>(query) - 1);
  const std::uint64_t later = PoseAt(graph, query);
  const std::uint64_t earlier = PoseAt(graph, matched);
  if (later == 0 || later > drive->last_sequence() || earlier == 0) return;
  std::shared_ptr<const MeasuredLoop> measured;
  if (UniformInt(random, 0, 3) > 0) {
    auto loop = std::make_shared<MeasuredLoop>(*RandomMeasurement(
        random, EstimateAt(graph, query), EstimateAt(graph, matched), 0.3));
    if (UniformInt(random, 0, 2) == 0) {
      loop->measurement.relative.x += Normal(random, 20.0);
      loop->measurement.relative.heading += Normal(random, 0.3);
    }
    measured = loop;
  }
  drive->AddLoopClosure(later, earlier, drive->revision() + 1, measured);
}

template <int D>
int ExpectThoseOfThePlainTwin(std::mt19937_64& random) {
  DriveSettings settings;
  settings.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  settings.apply_inflation = UniformInt(random, 0, 1) == 0;
  settings.search.use_belief = !settings.apply_inflation;
  Drive drive(settings);
  drive.Append(WanderingSamples<D>(random, 60), 1);
  for (NodeIndex query = UniformInt(random, 15, 40);
       query < drive.graph().size(); query += UniformInt(random, 1, 6)) {
    if (drive.confirmed().size() < 11) CloseAtRandom<D>(random, query, &drive);
  }
  oracle::PlainSuspects::Found found;
  for (const Suspect& suspect : FindSuspects(drive)) {
    for (std::size_t i = 0; i < drive.confirmed().size(); ++i) {
      const ConfirmedPair& pair = drive.confirmed()[i];
      if (pair.query_sequence == suspect.query_sequence &&
          pair.matched_sequence == suspect.matched_sequence) {
        found[i] = suspect.p_value;
      }
    }
  }
  const auto is_found = [&](const oracle::PlainSuspects::Found& answer) {
    return answer.size() == found.size() &&
           std::equal(answer.begin(), answer.end(), found.begin(),
                      [](const auto& a, const auto& b) {
                        return a.first == b.first &&
                               std::abs(a.second - b.second) <=
                                   1e-5 * a.second + 1e-12;
                      });
  };
  const auto answers = oracle::PlainSuspects(drive).All();
  EXPECT_TRUE(std::any_of(answers.begin(), answers.end(), is_found))
      << drive.confirmed().size() << " closures, " << found.size()
      << " suspects, " << answers.size() << " answers";
  return static_cast<int>(found.size());
}

TEST(SuspectsTest, AreThoseOfThePlainTwinInThePlane) {
  std::mt19937_64 random = SeededRandom();
  int suspects = 0;
  for (int trial = 0; trial < 80; ++trial) {
    SCOPED_TRACE(trial);
    suspects += ExpectThoseOfThePlainTwin<3>(random);
  }
  std::cout << suspects << " suspects\n";
  EXPECT_GT(suspects, 100);
}

TEST(SuspectsTest, AreThoseOfThePlainTwinInSpace) {
  std::mt19937_64 random = SeededRandom();
  int suspects = 0;
  for (int trial = 0; trial < 40; ++trial) {
    SCOPED_TRACE(trial);
    suspects += ExpectThoseOfThePlainTwin<4>(random);
  }
  std::cout << suspects << " suspects\n";
  EXPECT_GT(suspects, 40);
}

bool AreEqual(const std::vector<Suspect>& a, const std::vector<Suspect>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(),
                    [](const Suspect& x, const Suspect& y) {
                      return x.query_sequence == y.query_sequence &&
                             x.matched_sequence == y.matched_sequence &&
                             x.occurrence == y.occurrence &&
                             x.p_value == y.p_value;
                    });
}

TEST(SuspectsTest, StoppingChangesNothing) {
  std::mt19937_64 random = SeededRandom();
  const ClosedDrive closed = RandomClosedDrive(
      DriveSettings(), 3000, WrongLoops::kAnywhere, false, random);
  const std::vector<Suspect> wanted = FindSuspects(closed.drive);
  EXPECT_FALSE(wanted.empty());
  for (const int slice : {1, 2, 17}) {
    SuspectSearch search(closed.drive);
    int left = 0;
    int slices = 1;
    const auto stop = [&] { return left-- == 0; };
    for (left = slice; !search.Run(stop); left = slice) ++slices;
    EXPECT_GT(slices, 3);
    EXPECT_TRUE(search.Run(nullptr));
    EXPECT_TRUE(AreEqual(search.suspects(), wanted)) << slice;
  }
}

TEST(SuspectsTest, AreNoneOnceTheSuspectsWereRemoved) {
  std::mt19937_64 random = SeededRandom();
  ClosedDrive closed = RandomClosedDrive(DriveSettings(), 3000,
                                         WrongLoops::kAnywhere, true, random);
  for (const Suspect& suspect : FindSuspects(closed.drive)) {
    closed.drive.RemoveLoopClosure(
        suspect.query_sequence, suspect.matched_sequence,
        closed.drive.revision() + 1, suspect.occurrence);
  }
  EXPECT_TRUE(FindSuspects(closed.drive).empty());
}

// Two laps of the ring, with closures at the same place every 60 m.
struct RingClosures {
  explicit RingClosures(const DriveSettings& settings = {},
                        std::size_t jump = 0)
      : drive(settings), truth(Ring(2200.0)) {
    std::vector<Pose> path = truth;
    // What lies behind is where it was not before.
    for (std::size_t i = jump; jump > 0 && i < path.size(); ++i) {
      path[i].x += 150.0;
    }
    drive.Append(oracle::WithCovariances(path, oracle::Noise{}), 1);
    for (std::size_t query = 1220; query < 2150; query += 60) Close(query, 0);
  }

  std::size_t FirstLap(std::size_t query) const {
    std::size_t nearest = 0;
    for (std::size_t i = 0; i + 500 < query; ++i) {
      if (TrueDistance(truth, i, query) < TrueDistance(truth, nearest, query)) {
        nearest = i;
      }
    }
    return nearest;
  }
  void Close(std::size_t query, std::size_t off) {
    drive.AddLoopClosure(query + 1, FirstLap(query) + off + 1,
                         drive.revision() + 1);
  }

  Drive drive;
  std::vector<Pose> truth;
};

TEST(SuspectsTest, AreNamedByTheirOccurrenceAmongThoseOfTheSamePoses) {
  RingClosures ring;
  EXPECT_TRUE(FindSuspects(ring.drive).empty());
  ring.Close(1700, 150);
  ring.Close(1700, 150);
  const std::vector<Suspect> suspects = FindSuspects(ring.drive);
  ASSERT_EQ(suspects.size(), 2u);
  for (const std::size_t k : {0, 1}) {
    EXPECT_EQ(suspects[k].query_sequence, 1701u);
    EXPECT_EQ(suspects[k].matched_sequence, ring.FirstLap(1700) + 151);
    EXPECT_EQ(suspects[k].occurrence, k);
  }
}

TEST(SuspectsTest, BeyondAJumpNothingIsContradicted) {
  DriveSettings settings;
  settings.max_step_meters = 50.0;
  EXPECT_TRUE(FindSuspects(RingClosures(settings, 1700).drive).empty());
  // The same without a jump contradicts itself.
  settings.max_step_meters = 1000.0;
  EXPECT_FALSE(FindSuspects(RingClosures(settings, 1700).drive).empty());
}

TEST(SuspectsTest, ClosuresOfTwoRecordingsAreNotJudged) {
  DriveSettings settings;
  std::vector<PoseSample> samples =
      oracle::WithCovariances(Ring(2200.0), oracle::Noise{});
  samples[1200].recording_start = std::make_shared<const RecordingStart>();
  Drive drive(settings);
  drive.Append(samples, 1);
  ASSERT_EQ(drive.recordings().size(), 2u);
  for (std::uint64_t k = 0; k < 10; ++k) {
    drive.AddLoopClosure(1300 + 20 * k, 1 + 100 * k, drive.revision() + 1);
  }
  EXPECT_TRUE(FindSuspects(drive).empty());
}

TEST(SuspectsTest, WhereClosuresShowNoDriftNoneIsJudged) {
  RingClosures dead_reckoning;
  dead_reckoning.Close(1700, 150);
  EXPECT_FALSE(FindSuspects(dead_reckoning.drive).empty());
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  RingClosures fixes(settings);
  fixes.Close(1700, 150);
  EXPECT_TRUE(FindSuspects(fixes.drive).empty());
}

TEST(SuspectsTest, ADriveWithoutClosuresHasNone) {
  EXPECT_TRUE(FindSuspects(Drive(DriveSettings())).empty());
}

}  // namespace
}  // namespace revisit::core
