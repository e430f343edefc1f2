// Marks that were saved as bytes and loaded.
#include "core/search/belief/mark_bytes.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/belief/mark.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/core/search/candidate_sets.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// Some laps of a ring, whose estimate has drifted.
std::vector<PoseSample> Laps(std::uint64_t seed, double meters) {
  std::mt19937_64 random(seed);
  oracle::Noise noise;
  noise.along_meters = 0.05;
  noise.across_meters = 0.03;
  noise.heading_radians = 0.001;
  return oracle::WithCovariances(
      oracle::DrawEstimate(Ring(meters), noise, random), noise);
}

std::unique_ptr<Drive> DriveOf(const std::vector<PoseSample>& samples,
                               const DriveSettings& settings = {}) {
  auto drive = std::make_unique<Drive>(settings);
  drive->Append(samples, 1);
  return drive;
}

CandidateSet AtEnd(const Drive& drive, Search* search) {
  return *search->AtEnd(drive.settings().search, nullptr);
}

bool MissesSome(const Drive& drive, Search* search) {
  return search
      ->FindMissingMark(drive.graph().size() - 1, drive.settings().search)
      .has_value();
}

std::string LearnedAtEnd(const Drive& drive) {
  Search search(&drive);
  AtEnd(drive, &search);
  return search.SaveMarks();
}

class MarkBytesTest : public ::testing::Test {
 protected:
  const std::vector<PoseSample> samples_ = Laps(7, 4200.0);
  const std::unique_ptr<Drive> drive_ = DriveOf(samples_);
  const std::string bytes_ = LearnedAtEnd(*drive_);
};

TEST_F(MarkBytesTest, ASearchWithLoadedMarksAnswersTheSameAndSearchesNone) {
  Search never(drive_.get());
  const CandidateSet expected = AtEnd(*drive_, &never);
  ASSERT_FALSE(expected.candidates.empty());
  // Another drive of the same poses, as after a restart.
  const auto again = DriveOf(samples_);
  Search loaded(again.get());
  ASSERT_TRUE(MissesSome(*again, &loaded));
  EXPECT_EQ(loaded.marks_version(), 0u);
  ASSERT_TRUE(loaded.LoadMarks(bytes_));
  EXPECT_GT(loaded.marks_version(), 0u);
  EXPECT_EQ(loaded.mark_count(), never.mark_count());
  EXPECT_FALSE(MissesSome(*again, &loaded));
  const std::uint64_t version = loaded.marks_version();
  ExpectSameAnswers(AtEnd(*again, &loaded), expected);
  EXPECT_EQ(loaded.marks_version(), version);
  EXPECT_EQ(loaded.SaveMarks(), bytes_);
}

TEST_F(MarkBytesTest, ADriveThatHasGrownTakesTheMarksOfBefore) {
  const auto shorter =
      DriveOf({samples_.begin(), samples_.begin() + 3 * samples_.size() / 4});
  Search grown(drive_.get());
  ASSERT_TRUE(grown.LoadMarks(LearnedAtEnd(*shorter)));
  EXPECT_GT(grown.mark_count(), 20u);
  Search never(drive_.get());
  ExpectSameAnswers(AtEnd(*drive_, &grown), AtEnd(*drive_, &never));
}

TEST_F(MarkBytesTest, NoMarksAreSavedAndLoadedToo) {
  const Drive empty((DriveSettings()));
  Search search(&empty);
  EXPECT_TRUE(search.LoadMarks(search.SaveMarks()));
  EXPECT_EQ(search.mark_count(), 0u);
  EXPECT_FALSE(search.LoadMarks(bytes_));
  EXPECT_FALSE(search.LoadMarks(""));
}

TEST_F(MarkBytesTest, MarksOfOtherSettingsAreRefused) {
  using Change = std::function<void(DriveSettings*)>;
  const auto takes = [&](const Change& change) {
    DriveSettings settings;
    change(&settings);
    const auto other = DriveOf(samples_, settings);
    Search search(other.get());
    const bool taken = search.LoadMarks(bytes_);
    EXPECT_EQ(search.mark_count() > 0, taken);
    return taken;
  };
  EXPECT_TRUE(takes([](auto) {}));
  // Marks do not depend on this.
  EXPECT_TRUE(takes([](auto* s) { s->search.max_candidates = 7; }));
  EXPECT_TRUE(takes([](auto* s) { s->search.gate_probability = 0.5; }));
  EXPECT_TRUE(takes([](auto* s) { s->check_interval_meters = 80.0; }));
  for (const Change& change : std::vector<Change>{
           [](auto* s) { s->node_spacing_meters = 2.5; },
           [](auto* s) { s->max_step_meters = 50.0; },
           [](auto* s) { s->state_space = StateSpace::kSpatial; },
           [](auto* s) { s->search.sequence_length_meters += 1.0; },
           [](auto* s) { s->search.alignment = AlignmentKind::kComposite; },
           [](auto* s) {
             s->search.correlation_model = CorrelationModel::kIndependent;
           },
           [](auto* s) { s->search.place_tolerance.position_meters = 7.0; },
           [](auto* s) { s->search.candidate_separation_meters = 40.0; },
           [](auto* s) { s->search.shape.correlation_meters = 30.0; },
           [](auto* s) { s->search.road_spacing_meters = 50.0; }}) {
    EXPECT_FALSE(takes(change));
  }
}

TEST_F(MarkBytesTest, MarksOfOtherPosesAreRefused) {
  // The path is longer, so that all marks are there.
  const auto other = DriveOf(Laps(8, 4400.0));
  Search search(other.get());
  EXPECT_FALSE(search.LoadMarks(bytes_));
  EXPECT_EQ(search.mark_count(), 0u);
  // Nodes that are no longer there, as after an accepted loss.
  const auto shorter =
      DriveOf({samples_.begin(), samples_.begin() + samples_.size() / 2});
  EXPECT_FALSE(Search(shorter.get()).LoadMarks(bytes_));
}

TEST_F(MarkBytesTest, ARefusalLeavesWhatIsKnown) {
  Search search(drive_.get());
  const CandidateSet expected = AtEnd(*drive_, &search);
  const std::size_t known = search.mark_count();
  EXPECT_FALSE(search.LoadMarks(bytes_.substr(0, bytes_.size() - 1)));
  EXPECT_EQ(search.mark_count(), known);
  EXPECT_EQ(search.SaveMarks(), bytes_);
}

TEST_F(MarkBytesTest, EvidenceOfSettingsOfBeforeIsNotSaved) {
  Search search(drive_.get());
  AtEnd(*drive_, &search);
  DriveSettings wider;
  wider.search.road_spacing_meters = 50.0;
  ASSERT_TRUE(drive_->ChangeSettings(wider, drive_->revision() + 1).ok());
  const std::string none = search.SaveMarks();
  EXPECT_LT(none.size(), 200u);
  EXPECT_TRUE(search.LoadMarks(none));
}

TEST_F(MarkBytesTest, BytesThatWereCutAreRefused) {
  Search search(drive_.get());
  for (std::size_t size = 0; size < bytes_.size(); ++size) {
    ASSERT_FALSE(search.LoadMarks(bytes_.substr(0, size))) << size;
  }
  EXPECT_FALSE(search.LoadMarks(bytes_ + '\0'));
}

// The storage's checksums find such damage; here it must only do no harm.
TEST_F(MarkBytesTest, FlippedBitsAreRefusedOrDoNoHarm) {
  std::mt19937_64 random = SeededRandom();
  int usable = 0;
  for (int round = 0; round < 3000; ++round) {
    std::string bytes = bytes_;
    for (int flips = UniformInt(random, 1, 3); flips > 0; --flips) {
      const int at = UniformInt(random, 0, static_cast<int>(bytes.size()) - 1);
      bytes[static_cast<std::size_t>(at)] ^=
          static_cast<char>(1 << UniformInt(random, 0, 7));
    }
    Search search(drive_.get());
    if (!search.LoadMarks(bytes)) continue;
    ++usable;
    if (round % 50 != 0) continue;
    EXPECT_TRUE(search.AtEnd(drive_->settings().search, nullptr).ok());
  }
  EXPECT_GT(usable, 0);
  EXPECT_LT(usable, 3000);
}

TEST_F(MarkBytesTest, AnyBytesAreRefused) {
  std::mt19937_64 random = SeededRandom();
  Search search(drive_.get());
  for (int round = 0; round < 2000; ++round) {
    // Behind a sound beginning, half of the time.
    std::string bytes = bytes_.substr(
        0, round % 2 == 0 ? 0
                          : static_cast<std::size_t>(UniformInt(
                                random, 0, static_cast<int>(bytes_.size()))));
    for (int k = UniformInt(random, 1, 300); k > 0; --k) {
      bytes += static_cast<char>(UniformInt(random, 0, 255));
    }
    EXPECT_FALSE(search.LoadMarks(bytes));
  }
}

// If this fails, and the change is meant: raise kMarksVersion of mark_bytes.cc,
// so that no server takes what an older one has found, and set the sums anew.
TEST(MarkBytesVersionTest, WhatMarksOfThisVersionShowIsKnown) {
  oracle::Noise noise;
  noise.along_meters = 0.05;
  noise.across_meters = 0.03;
  noise.heading_radians = 0.001;
  const auto drive = DriveOf(oracle::WithCovariances(Ring(4200.0), noise));
  const std::string bytes = LearnedAtEnd(*drive);
  MarkMemory marks;
  ASSERT_TRUE(LoadMarks(
      bytes, {drive->graph(), MarkSpacing(drive->settings()), drive->dropped()},
      drive->settings(), &marks));
  double evidence = 0.0;
  double all_evidence = 0.0;
  double odds = 0.0;
  NodeIndex matched = 0;
  for (const auto& [mark, shown] : marks.all()) {
    evidence += shown.log_evidence[3];
    all_evidence += shown.log_all_evidence[4];
    if (!shown.matched) continue;
    odds += shown.log_matched_odds[4];
    matched += *shown.matched;
  }
  EXPECT_EQ(bytes.size(), 10152u);
  EXPECT_EQ(matched, 33069);
  // Libraries may round another way.
  EXPECT_NEAR(evidence, 778.88243685, 1e-6);
  EXPECT_NEAR(all_evidence, 736.96946972, 1e-6);
  EXPECT_NEAR(odds, 502.24596482, 1e-6);
}

}  // namespace
}  // namespace revisit::core
