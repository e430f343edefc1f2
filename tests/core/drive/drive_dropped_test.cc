// Drives that go on behind poses that were dropped.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

using Poses = std::vector<PoseSample>;

Poses Part(const Poses& all, std::uint64_t first, std::uint64_t last) {
  return {all.begin() + static_cast<std::ptrdiff_t>(first) - 1,
          all.begin() + static_cast<std::ptrdiff_t>(last)};
}

// The stretch that is left of the poses [first, last].
DroppedStretch Dropped(const Drive& drive, const Poses& all,
                       std::uint64_t first, std::uint64_t last) {
  DroppedStretchMaker maker(drive.resampler_options());
  if (first > 1) maker.Begin(all[first - 2].pose);
  for (const PoseSample& sample : Part(all, first, last)) maker.Add(sample);
  if (last < all.size()) maker.End(all[last].pose);
  return maker.Take();
}

// A drive without these poses.
void DriveWithout(
    const Poses& all,
    const std::vector<std::pair<std::uint64_t, std::uint64_t>>& gaps,
    Drive* drive) {
  std::uint64_t next = 1;
  for (const auto& [first, last] : gaps) {
    if (first > next) {
      drive->Append(Part(all, next, first - 1), drive->revision() + 1);
    }
    drive->Skip(Dropped(*drive, all, first, last), drive->revision() + 1);
    next = last + 1;
  }
  drive->Append(Part(all, next, all.size()), drive->revision() + 1);
}

// Laps of a course of 600 m with exact fixes.
Poses ThreeLaps() {
  Trip trip;
  for (int lap = 0; lap < 3; ++lap) {
    for (int side = 0; side < 4; ++side) {
      trip.Straight(119.0).Turn(90.0, 20.0);
    }
  }
  return WithDeviations(trip.poses(), 0.5, 0.02);
}

TEST(DriveDroppedTest, GoesOnWithANewSegmentThatIsNoJump) {
  const Poses all = ThreeLaps();
  Drive whole((DriveSettings()));
  whole.Append(all, 1);
  Drive drive((DriveSettings()));
  drive.Append(Part(all, 1, 400), 1);
  drive.Skip(Dropped(drive, all, 401, 800), 2);
  const AppendResult result = drive.Append(Part(all, 801, all.size()), 3);
  EXPECT_THAT(result.jumps, IsEmpty());
  EXPECT_EQ(drive.last_sequence(), all.size());
  EXPECT_NEAR(drive.travelled_meters(), whole.travelled_meters(), 1e-6);
  const NodeIndex after = *drive.graph().NodeAtOrBefore(801);
  EXPECT_EQ(drive.graph().node(after).sequence, 801u);
  EXPECT_EQ(drive.graph().SegmentStart(after), after);
  EXPECT_EQ(drive.graph().node(after - 1).sequence, 400u - 1u);
  EXPECT_TRUE(drive.dropped().Contains(600));
  EXPECT_FALSE(drive.dropped().Contains(801));
  // Checks fall due as often as ever.
  for (std::size_t i = 1; i < result.checks_due.size(); ++i) {
    EXPECT_NEAR(drive.graph().MetersApart(result.checks_due[i],
                                          result.checks_due[i - 1]),
                50.0, 2.0);
  }
}

TEST(DriveDroppedTest, MayBeginWithWhatWasDropped) {
  const Poses all = ThreeLaps();
  Drive drive((DriveSettings()));
  DriveWithout(all, {{1, 700}}, &drive);
  EXPECT_EQ(drive.graph().node(0).sequence, 701u);
  EXPECT_NEAR(drive.graph().node(0).travelled_meters, 700.0, 10.0);
  EXPECT_EQ(drive.dropped().KeptFrom(1), 701u);
  EXPECT_EQ(drive.dropped().count(), 700u);
}

TEST(DriveDroppedTest, PairsWithADroppedPoseHaveNoEffect) {
  const Poses all = ThreeLaps();
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  Drive drive(settings);
  DriveWithout(all, {{300, 700}}, &drive);
  drive.AddLoopClosure(1200, 500, drive.revision() + 1);
  drive.AddRejection(1300, 600, drive.revision() + 1);
  EXPECT_THAT(drive.graph().LoopEdges(), IsEmpty());
  EXPECT_EQ(drive.consistency().confirmed, 0);
  EXPECT_EQ(drive.consistency().rejected, 0);
  drive.AddLoopClosure(1200, 100, drive.revision() + 1);
  EXPECT_EQ(drive.consistency().confirmed, 1);
  drive.RemoveLoopClosure(1200, 500, drive.revision() + 1);
  drive.RemoveRejection(1300, 600, drive.revision() + 1);
  EXPECT_EQ(drive.consistency().confirmed, 1);
}

TEST(DriveDroppedTest, FindsAPlaceAmongThePassesThatAreLeft) {
  const Poses all = ThreeLaps();
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  Drive drive(settings);
  // The second lap is gone.
  DriveWithout(all, {{700, 1150}}, &drive);
  const auto found =
      Search(&drive).AtEnd(settings.search, [] { return false; });
  ASSERT_TRUE(found.ok());
  ASSERT_FALSE(found->candidates.empty());
  const Pose at = drive.graph().pose(found->candidates.front().matched);
  const Pose query = drive.graph().pose(*found->query);
  EXPECT_LT(std::hypot(at.x - query.x, at.y - query.y), 5.0);
}

// Errors that a filter carries on are carried over what was dropped as they
// would have been through it.
TEST(DriveDroppedTest, AFilterCarriesItsErrorsOn) {
  std::mt19937_64 random = SeededRandom();
  Poses all = WithDeviations(Trip().Straight(60.0).poses(), 0.5, 0.02);
  for (PoseSample& sample : all) {
    if (sample.sequence == 1) continue;
    sample.transition.emplace();
    for (std::size_t k = 0; k < 16; ++k) {
      // Nothing of z, which planar vehicles do not have.
      if (k / 4 == 2 || k % 4 == 2) continue;
      sample.transition->values[k] += Normal(random, 0.02);
    }
  }
  for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
    DriveSettings settings;
    settings.state_space = space;
    // A node at each pose.
    settings.node_spacing_meters = 1.0;
    settings.search.correlation_model = CorrelationModel::kFilter;
    Drive whole(settings);
    whole.Append(all, 1);
    Drive drive(settings);
    DriveWithout(all, {{20, 27}, {28, 40}}, &drive);
    const NodeIndex before = *drive.graph().NodeAtOrBefore(15);
    const NodeIndex after = *drive.graph().NodeAtOrBefore(50);
    const auto expect_near = [](const auto& a, const auto& b) {
      EXPECT_LT((a - b).norm(), 1e-9 * (1.0 + b.norm())) << a << "\n" << b;
    };
    const NodeIndex from = *whole.graph().NodeAtOrBefore(15);
    const NodeIndex to = *whole.graph().NodeAtOrBefore(50);
    if (space == StateSpace::kPlanar) {
      expect_near(CarriedTransition<3>(drive.graph(), before, after),
                  CarriedTransition<3>(whole.graph(), from, to));
    } else {
      expect_near(CarriedTransition<4>(drive.graph(), before, after),
                  CarriedTransition<4>(whole.graph(), from, to));
    }
  }
}

TEST(DriveDroppedTest, IsSavedAndLoadedAsItIs) {
  std::mt19937_64 random = SeededRandom();
  for (const CorrelationModel model :
       {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
        CorrelationModel::kFilter}) {
    Poses all =
        WithDeviations(Trip().Winding(0.0, 25'000.0).poses(), 0.5, 0.02);
    for (PoseSample& sample : all) {
      if (model == CorrelationModel::kFilter && sample.sequence > 1) {
        sample.transition.emplace().values[1] = Normal(random, 1e-3);
      }
    }
    DriveSettings settings;
    settings.search.correlation_model = model;
    settings.node_spacing_meters = 1.0;
    Drive drive(settings);
    DriveWithout(all, {{1, 300}, {4000, 5500}, {20'000, 21'000}}, &drive);
    Drive loaded(settings);
    const std::size_t parts = drive.whole_parts();
    ASSERT_GT(parts, 1u);
    for (std::size_t k = 0; k < parts; ++k) {
      ASSERT_TRUE(loaded.LoadPart(drive.SavePart(k)));
    }
    ASSERT_TRUE(loaded.LoadRest(drive.SaveRest(parts)));
    EXPECT_EQ(loaded.SaveRest(0), drive.SaveRest(0));
    EXPECT_EQ(loaded.dropped().count(), 300u + 1501u + 1001u);
    EXPECT_EQ(loaded.travelled_meters(), drive.travelled_meters());
  }
}

}  // namespace
}  // namespace revisit::core
