// Searches over several recordings of one drive.
#include <gtest/gtest.h>

#include <cstdint>
#include <memory>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"

namespace revisit::core {
namespace {

// The ring, driven on in parts that end at these metres, each of which is
// reckoned anew from its first pose; poses are in one frame. Between two parts
// 20 m are missing.
std::vector<PoseSample> RingInParts(const std::vector<int>& ends,
                                    const RecordingStart* start) {
  const std::vector<Pose> ring = Ring(static_cast<double>(ends.back()));
  std::vector<PoseSample> samples;
  StateMatrix<4> covariance;
  std::size_t part = 0;
  bool begins = true;
  for (std::size_t i = 0; i < ring.size(); ++i) {
    if (part + 1 < ends.size() && i >= static_cast<std::size_t>(ends[part])) {
      ++part;
      begins = true;
      i += 20;
    }
    PoseSample sample;
    sample.sequence = samples.size() + 1;
    sample.pose = ring[i];
    if (begins) {
      covariance = StateMatrix<4>::Identity() * 0.01;
      sample.transition = ToErrorTransition<4>(StateMatrix<4>::Zero());
      if (start != nullptr) {
        sample.recording_start = std::make_shared<const RecordingStart>(*start);
      }
    } else {
      const StateMatrix<4> psi =
          DeadReckoningTransition<4>(samples.back().pose, sample.pose);
      covariance = (psi * covariance * psi.transpose()).eval();
      covariance.diagonal() += StateVector<4>(1e-3, 1e-3, 1e-3, 1e-7);
      sample.transition = ToErrorTransition<4>(psi);
    }
    begins = false;
    sample.covariance = ToCovariance<4>(covariance);
    samples.push_back(sample);
  }
  return samples;
}

CandidateSet AnswerAtEnd(const Drive& drive) {
  Search search(&drive);
  auto set = search.AtEnd(drive.settings().search, nullptr);
  EXPECT_TRUE(set.ok());
  return *set;
}

// Frames that are tied without an error are one frame; then errors are those of
// a filter that forgets all where a recording begins.
TEST(SearchRecordingsTest, ExactDatumsAreAFilterThatForgets) {
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kFilter;
  settings.max_step_meters = 10.0;
  RecordingStart exact;
  exact.relation = RecordingRelation::kDatum;
  for (int i = 0; i < 4; ++i) exact.covariance(i, i) = 1e-14;
  // The last part is so short that no overlap is longer in other recordings.
  const std::vector<int> ends = {1300, 2600, 2850};
  Drive apart(settings);
  apart.Append(RingInParts(ends, &exact), 1);
  ASSERT_EQ(apart.recordings().size(), 3u);
  Drive one(settings);
  one.Append(RingInParts(ends, nullptr), 1);
  ASSERT_EQ(one.recordings().size(), 1u);
  ASSERT_EQ(apart.graph().size(), one.graph().size());
  const CandidateSet a = AnswerAtEnd(apart);
  const CandidateSet b = AnswerAtEnd(one);
  ASSERT_GE(a.candidates.size(), 2u);
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  EXPECT_NEAR(*a.new_place_probability, *b.new_place_probability, 1e-6);
  for (std::size_t i = 0; i < a.candidates.size(); ++i) {
    const Candidate& x = a.candidates[i];
    const Candidate& y = b.candidates[i];
    EXPECT_EQ(x.matched, y.matched);
    EXPECT_EQ(x.verdict, y.verdict);
    EXPECT_NEAR(x.score, y.score, 1e-6);
    EXPECT_NEAR(x.relative->probability, y.relative->probability, 1e-6);
    EXPECT_NEAR(x.difference->gate.squared_mahalanobis,
                y.difference->gate.squared_mahalanobis, 1e-6);
    EXPECT_EQ(x.frame_state, FrameState::kDatum);
  }
}

TEST(SearchRecordingsTest, EveryNodeIsConsideredOrPrunedOnce) {
  for (const bool exhaustive : {false, true}) {
    DriveSettings settings;
    settings.search.exhaustive = exhaustive;
    RecordingStart after;
    after.covariance = UsualGap();
    Drive drive(settings);
    drive.Append(RingInParts({1300, 2600, 3500}, &after), 1);
    const CandidateSet set = AnswerAtEnd(drive);
    const NodeIndex sequence = 75;
    EXPECT_EQ(set.nodes_considered + set.nodes_pruned,
              drive.graph().size() - sequence);
    if (exhaustive) {
      EXPECT_EQ(set.nodes_pruned, 0);
    }
    EXPECT_FALSE(set.candidates.empty());
  }
}

TEST(SearchRecordingsTest, AnswersAreTheSameFromTheStartAndAfterOtherSearches) {
  DriveSettings settings;
  RecordingStart after;
  after.covariance = UsualGap();
  Drive drive(settings);
  drive.Append(RingInParts({1300, 2600, 4200}, &after), 1);
  Search kept(&drive);
  for (NodeIndex query = 1400; query < drive.graph().size(); query += 61) {
    const auto again = kept.At(query, settings.search, nullptr);
    const auto fresh = Search(&drive).At(query, settings.search, nullptr);
    ASSERT_TRUE(again.ok() && fresh.ok());
    ASSERT_EQ(again->candidates.size(), fresh->candidates.size()) << query;
    EXPECT_EQ(again->new_place_probability, fresh->new_place_probability);
    for (std::size_t i = 0; i < again->candidates.size(); ++i) {
      EXPECT_EQ(again->candidates[i].matched, fresh->candidates[i].matched);
      EXPECT_EQ(again->candidates[i].score, fresh->candidates[i].score);
    }
  }
}

TEST(SearchRecordingsTest, WhatWasRejectedInAnotherRecordingIsNoCandidate) {
  DriveSettings settings;
  RecordingStart after;
  after.covariance = UsualGap();
  Drive drive(settings);
  drive.Append(RingInParts({1300, 2600}, &after), 1);
  const CandidateSet before = AnswerAtEnd(drive);
  ASSERT_FALSE(before.candidates.empty());
  const NodeIndex matched = before.candidates[0].matched;
  ASSERT_LT(matched, drive.recordings()[1].first_node);
  drive.AddRejection(drive.last_sequence(),
                     drive.graph().node(matched).sequence, 2);
  for (const Candidate& candidate : AnswerAtEnd(drive).candidates) {
    EXPECT_GT(drive.graph().MetersApart(candidate.matched, matched), 8.0);
  }
}

// A composite alignment knows no other frame.
TEST(SearchRecordingsTest, CompositeAlignmentsStayInTheirRecording) {
  DriveSettings settings;
  settings.search.alignment = AlignmentKind::kComposite;
  RecordingStart after;
  after.covariance = UsualGap();
  Drive drive(settings);
  drive.Append(RingInParts({1300, 2900}, &after), 1);
  for (const Candidate& candidate : AnswerAtEnd(drive).candidates) {
    EXPECT_GE(candidate.matched, drive.recordings()[1].first_node);
    EXPECT_EQ(candidate.frame_state, FrameState::kSame);
  }
}

}  // namespace
}  // namespace revisit::core
