#include "core/drive/recordings.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/drive.h"
#include "core/drive/frame_relation.h"
#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/search/search.h"
#include "tests/core/drive/drives.h"
#include "tests/core/graphs.h"

namespace revisit::core {
namespace {

std::shared_ptr<const RecordingStart> StartOf(RecordingRelation relation) {
  RecordingStart start;
  start.relation = relation;
  start.covariance = UsualGap();
  return std::make_shared<const RecordingStart>(start);
}

// The course of the ring, driven once in each recording, which has a frame of
// its own: it is where the frame of the recording before is, seen from this
// pose. Claims grow from next to nothing in each.
constexpr Pose kMoved{100.0, -50.0, 0.0, 0.4};
std::vector<PoseSample> RingsApart(
    const std::vector<std::shared_ptr<const RecordingStart>>& starts) {
  std::vector<PoseSample> all;
  Pose frame;
  for (const auto& start : starts) {
    StateMatrix<4> covariance = StateMatrix<4>::Identity() * 1e-4;
    std::vector<PoseSample> ring = WithDeviations(Ring(1150.0), 1.0, 1.0);
    for (std::size_t i = 0; i < ring.size(); ++i) {
      PoseSample sample = ring[i];
      sample.sequence = all.size() + 1;
      sample.pose = Compose(frame, sample.pose);
      if (i == 0) {
        sample.recording_start = start;
      } else {
        const StateMatrix<4> psi =
            DeadReckoningTransition<4>(all.back().pose, sample.pose);
        covariance = (psi * covariance * psi.transpose()).eval();
        covariance.diagonal() += Eigen::Vector4d(1e-3, 1e-3, 1e-3, 1e-7);
      }
      sample.covariance = ToCovariance<4>(covariance);
      all.push_back(sample);
    }
    frame = Compose(kMoved, frame);
  }
  return all;
}

// The frame of a recording as the last one sees it.
FrameRelation PlaceOf(const Drive& drive, std::size_t k) {
  return drive.RelationsAt(drive.graph().size() - 1)
      .From(drive.recordings().size() - 1)[k];
}

TEST(RecordingsTest, ADriveThatWasToldOfNoneHasOne) {
  Recordings recordings;
  EXPECT_EQ(recordings.size(), 1u);
  EXPECT_EQ(recordings.Of(1000), 0u);
  EXPECT_EQ(recordings.OfSequence(5), 0u);
  EXPECT_EQ(recordings.NodesOf(0, 70).last, 70);
  ByteWriter writer;
  recordings.Save(&writer);
  EXPECT_EQ(writer.Take(), "");
}

TEST(RecordingsTest, NodesAndPosesBelongToTheRecordingThatBeganLast) {
  Recordings recordings;
  recordings.Begin(11, 4, StartOf(RecordingRelation::kAfter), {});
  recordings.Begin(21, 9, StartOf(RecordingRelation::kUnknown), {});
  ASSERT_EQ(recordings.size(), 3u);
  EXPECT_EQ(recordings[0].start, nullptr);
  EXPECT_EQ(recordings[0].first_sequence, 1u);
  const std::size_t of_node[] = {0, 0, 0, 0, 1, 1, 1, 1, 1, 2, 2};
  for (NodeIndex i = 0; i < 11; ++i) {
    EXPECT_EQ(recordings.Of(i), of_node[i]) << i;
  }
  EXPECT_EQ(recordings.OfSequence(10), 0u);
  EXPECT_EQ(recordings.OfSequence(11), 1u);
  EXPECT_EQ(recordings.OfSequence(99), 2u);
  EXPECT_EQ(recordings.NodesOf(1, 30).first, 4);
  EXPECT_EQ(recordings.NodesOf(1, 30).last, 9);
  EXPECT_EQ(recordings.NodesOf(2, 30).last, 30);
}

TEST(RecordingsTest, WhatIsSavedIsLoadedAndDamageIsFound) {
  Recordings recordings;
  RecordingStart start;
  start.relation = RecordingRelation::kDatum;
  start.covariance = UsualGap();
  start.datum = {1.0, 2.0, 0.0, 0.5};
  start.datum_id = "site";
  start.label = "monday";
  recordings.Begin(11, 4, std::make_shared<const RecordingStart>(start),
                   {7.0, 8.0, 0.0, 1.0});
  ByteWriter writer;
  recordings.Save(&writer);
  const std::string bytes = writer.Take();
  const auto load = [](const std::string& saved, Recordings* loaded) {
    ByteReader reader(saved);
    return loaded->Load(StateSpace::kPlanar, 10, 20, &reader) &&
           reader.rest().empty();
  };
  Recordings loaded;
  ASSERT_TRUE(load(bytes, &loaded));
  ASSERT_EQ(loaded.size(), 2u);
  EXPECT_EQ(*loaded[1].start, start);
  EXPECT_EQ(loaded[1].first_node, 4);
  EXPECT_EQ(loaded[1].end_before.y, 8.0);
  for (std::size_t length = 1; length < bytes.size(); ++length) {
    Recordings cut;
    EXPECT_FALSE(load(bytes.substr(0, length), &cut)) << length;
  }
}

TEST(RecordingsTest, ARecordingBeginsASegmentAndIsNoJump) {
  Drive drive{DriveSettings()};
  const std::vector<PoseSample> samples =
      RingsApart({nullptr, StartOf(RecordingRelation::kUnknown)});
  const AppendResult result = drive.Append(samples, 1);
  EXPECT_TRUE(result.jumps.empty());
  ASSERT_EQ(drive.recordings().size(), 2u);
  const Recording& second = drive.recordings()[1];
  EXPECT_EQ(second.first_sequence, samples.size() / 2 + 1);
  EXPECT_EQ(drive.graph().SegmentStart(second.first_node), second.first_node);
  EXPECT_EQ(drive.graph().node(second.first_node).sequence,
            second.first_sequence);
  EXPECT_TRUE(drive.findings().empty());

  // Nobody has told of this one.
  Drive untold{DriveSettings()};
  untold.Append(RingsApart({nullptr, nullptr}), 1);
  ASSERT_EQ(untold.findings().size(), 1u);
  EXPECT_EQ(untold.findings()[0].code, FindingCode::kNewFrame);
}

TEST(RecordingsTest, TheGapIsThatFromTheLastPoseAndNotFromTheLastNode) {
  DriveSettings settings;
  settings.node_spacing_meters = 5.0;
  Drive drive(settings);
  const std::vector<PoseSample> samples =
      RingsApart({nullptr, StartOf(RecordingRelation::kAfter)});
  // The last node is none of the last pose.
  const std::size_t half = samples.size() / 2;
  drive.Append(samples, 1);
  const Pose end = samples[half - 1].pose;
  const Pose start = samples[half].pose;
  const Pose placed = Compose(PlaceOf(drive, 0).transform, end);
  EXPECT_NEAR(placed.x, start.x, 1e-6);
  EXPECT_NEAR(placed.y, start.y, 1e-6);
  EXPECT_NEAR(WrapHeading(placed.heading - start.heading), 0.0, 1e-9);
}

// The last search of a drive.
CandidateSet AskedAtEnd(const Drive& drive, const SearchOptions& options) {
  Search search(&drive);
  const auto set = search.AtEnd(options, nullptr);
  EXPECT_TRUE(set.ok());
  return *set;
}

TEST(RecordingsTest, ASecondRecordingFindsTheFirstWhereverItsFrameLies) {
  DriveSettings settings;
  for (const RecordingRelation relation :
       {RecordingRelation::kAfter, RecordingRelation::kUnknown}) {
    SCOPED_TRACE(static_cast<int>(relation));
    Drive drive(settings);
    drive.Append(RingsApart({nullptr, StartOf(relation)}), 1);
    const CandidateSet set = AskedAtEnd(drive, settings.search);
    ASSERT_FALSE(set.candidates.empty());
    const Candidate& best = set.candidates[0];
    EXPECT_LT(best.matched, drive.recordings()[1].first_node);
    EXPECT_EQ(best.frame_state, relation == RecordingRelation::kAfter
                                    ? FrameState::kAfter
                                    : FrameState::kNone);
  }
}

TEST(RecordingsTest, ADriveThatWasLoadedHasTheRecordingsThatWereSaved) {
  DriveSettings settings;
  Drive drive(settings);
  drive.Append(RingsApart({StartOf(RecordingRelation::kDatum),
                           StartOf(RecordingRelation::kAfter),
                           StartOf(RecordingRelation::kDatum)}),
               1);
  Drive loaded(settings);
  for (std::size_t part = 0; part < drive.whole_parts(); ++part) {
    ASSERT_TRUE(loaded.LoadPart(drive.SavePart(part)));
  }
  ASSERT_TRUE(loaded.LoadRest(drive.SaveRest(drive.whole_parts())));
  ASSERT_EQ(loaded.recordings().size(), 3u);
  for (std::size_t k = 0; k < 3; ++k) {
    EXPECT_EQ(*loaded.recordings()[k].start, *drive.recordings()[k].start);
    EXPECT_EQ(PlaceOf(loaded, k).state, PlaceOf(drive, k).state);
    EXPECT_EQ(PlaceOf(loaded, k).transform.x, PlaceOf(drive, k).transform.x);
  }
  const CandidateSet a = AskedAtEnd(drive, settings.search);
  const CandidateSet b = AskedAtEnd(loaded, settings.search);
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  for (std::size_t i = 0; i < a.candidates.size(); ++i) {
    EXPECT_EQ(a.candidates[i].score, b.candidates[i].score);
    EXPECT_EQ(a.candidates[i].matched, b.candidates[i].matched);
  }
}

TEST(RecordingsTest, AClosureAcrossRecordingsTiesTheirFrames) {
  DriveSettings settings;
  Drive drive(settings);
  drive.Append(RingsApart({nullptr, StartOf(RecordingRelation::kUnknown)}), 1);
  EXPECT_EQ(PlaceOf(drive, 0).state, FrameState::kNone);
  const std::uint64_t half = drive.last_sequence() / 2;
  for (std::uint64_t k = 1; k <= 3; ++k) {
    drive.AddLoopClosure(half + 20 * k, 20 * k, 1 + k);
    EXPECT_EQ(PlaceOf(drive, 0).state,
              k < 3 ? FrameState::kProvisional : FrameState::kKnown)
        << k;
  }
  const Pose placed = PlaceOf(drive, 0).transform;
  EXPECT_NEAR(placed.x, kMoved.x, 1.0);
  EXPECT_NEAR(placed.y, kMoved.y, 1.0);
  EXPECT_NEAR(placed.heading, kMoved.heading, 0.01);
  // It shows nothing of the claims.
  EXPECT_EQ(drive.consistency().confirmed, 0);
  const CandidateSet set = AskedAtEnd(drive, settings.search);
  ASSERT_FALSE(set.candidates.empty());
  EXPECT_EQ(set.candidates[0].verdict, Verdict::kAccepted);
  EXPECT_EQ(set.candidates[0].frame_state, FrameState::kKnown);
  ASSERT_TRUE(set.candidates[0].difference);
  EXPECT_NEAR(set.candidates[0].difference->difference.x, 0.0, 5.0);
}

TEST(RecordingsTest, AClosureThatContradictsOthersMovesNothing) {
  Drive drive{DriveSettings()};
  drive.Append(RingsApart({nullptr, StartOf(RecordingRelation::kUnknown)}), 1);
  const std::uint64_t half = drive.last_sequence() / 2;
  drive.AddLoopClosure(half + 20, 20, 2);
  drive.AddLoopClosure(half + 40, 40, 3);
  const Pose before = PlaceOf(drive, 0).transform;
  // Half a ring off.
  drive.AddLoopClosure(half + 50, 50 + half / 2, 4);
  EXPECT_EQ(PlaceOf(drive, 0).transform.x, before.x);
  EXPECT_EQ(PlaceOf(drive, 0).state, FrameState::kProvisional);
}

}  // namespace
}  // namespace revisit::core
