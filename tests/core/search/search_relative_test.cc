// Relative alignments through a search: the candidates and their evidence.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// The noise that the dead reckoning of these tests adds.
oracle::Noise LittleNoise() {
  oracle::Noise noise;
  noise.heading_radians = 0.0003;
  return noise;
}

Drive Driven(const std::vector<PoseSample>& samples,
             const DriveSettings& settings = {}) {
  Drive drive(settings);
  drive.Append(samples, 1);
  return drive;
}

Drive Driven(const std::vector<Pose>& poses,
             const DriveSettings& settings = {}) {
  return Driven(oracle::WithCovariances(poses, LittleNoise()), settings);
}

DriveSettings IndependentSettings() {
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  return settings;
}

CandidateSet Find(const Drive& drive, const SearchOptions& options) {
  auto set = Search(&drive).AtEnd(options, nullptr);
  EXPECT_TRUE(set.ok());
  return *std::move(set);
}

CandidateSet Find(const Drive& drive) {
  return Find(drive, drive.settings().search);
}

double TravelledAt(const Drive& drive, const Candidate& candidate) {
  return drive.graph().node(candidate.matched).travelled_meters;
}

// One lap of the ring.
double RingMeters(const Drive& drive) {
  const PoseGraph& graph = drive.graph();
  NodeIndex nearest = 200;
  for (NodeIndex i = 200; i < graph.size() && i < 900; ++i) {
    if (Distance(graph.node(i).pose, graph.node(0).pose, StateSpace::kPlanar) <
        Distance(graph.node(nearest).pose, graph.node(0).pose,
                 StateSpace::kPlanar)) {
      nearest = i;
    }
  }
  return graph.node(nearest).travelled_meters;
}

TEST(SearchRelativeTest, PathsAreToldOnlyIfAskedFor) {
  const Drive drive = Driven(Ring(1600.0));
  for (const AlignmentKind alignment :
       {AlignmentKind::kRelative, AlignmentKind::kComposite}) {
    SearchOptions options;
    options.alignment = alignment;
    const CandidateSet with = Find(drive, options);
    options.tell_paths = false;
    const CandidateSet without = Find(drive, options);
    ASSERT_FALSE(with.candidates.empty());
    ASSERT_EQ(without.candidates.size(), with.candidates.size());
    for (std::size_t i = 0; i < with.candidates.size(); ++i) {
      EXPECT_FALSE(with.candidates[i].path.empty());
      EXPECT_TRUE(without.candidates[i].path.empty());
      EXPECT_EQ(without.candidates[i].matched, with.candidates[i].matched);
      EXPECT_EQ(without.candidates[i].score, with.candidates[i].score);
      EXPECT_EQ(without.candidates[i].verdict, with.candidates[i].verdict);
    }
  }
}

TEST(SearchRelativeTest, ARoadIsAsProbableHoweverOftenItWasDriven) {
  const std::vector<Pose> lap = Ring(RingMeters(Driven(Ring(1600.0))));
  for (DriveSettings settings : {DriveSettings(), IndependentSettings()}) {
    std::vector<double> probabilities;
    for (const int times : {1, 16, 64}) {
      std::vector<Pose> poses;
      for (int k = 0; k < times; ++k) {
        poses.insert(poses.end(), lap.begin(), lap.end());
      }
      poses.insert(poses.end(), lap.begin(), lap.begin() + 600);
      const CandidateSet set = Find(Driven(poses, settings));
      ASSERT_FALSE(set.candidates.empty());
      EXPECT_EQ(set.candidates[0].verdict, Verdict::kAccepted);
      probabilities.push_back(set.candidates[0].relative->probability);
    }
    std::cout << "after 1, 16 and 64 rounds " << probabilities[0] << " "
              << probabilities[1] << " " << probabilities[2] << "\n";
    EXPECT_NEAR(probabilities[1], probabilities[0], 0.02);
    EXPECT_NEAR(probabilities[2], probabilities[0], 0.02);
  }
}

TEST(SearchRelativeTest, ASecondLapIsAccepted) {
  const Drive drive = Driven(Ring(1600.0));
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  const Candidate& best = set.candidates[0];
  EXPECT_NEAR(TravelledAt(drive, best), 1600.0 - RingMeters(drive), 2.5);
  EXPECT_EQ(best.rank, 1);
  EXPECT_EQ(best.verdict, Verdict::kAccepted);
  EXPECT_EQ(best.direction, Direction::kSame);
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kAccepted);
  ASSERT_TRUE(best.relative);
  EXPECT_EQ(best.relative->path_gate.verdict, GateVerdict::kAccepted);
  EXPECT_GT(best.relative->probability, 0.95);
  EXPECT_GT(best.relative->log_likelihood_ratio, 20.0);
  EXPECT_EQ(best.relative->overlap_meters, 298.0);
  ASSERT_EQ(best.path.size(), 150u);
  EXPECT_EQ(best.path.back(), std::make_pair(*set.query, best.matched));
  EXPECT_EQ(best.path.front().first, *set.query - 149);
  EXPECT_LT(*set.new_place_probability, 0.05);
  // The interval holds the place, which is known to a few metres.
  EXPECT_LE(best.relative->meters_before + best.relative->meters_after, 20.0);
  ASSERT_TRUE(set.scale);
  EXPECT_LE(set.scale->low, set.scale->scale);
  EXPECT_LE(set.scale->scale, set.scale->high);
}

TEST(SearchRelativeTest,
     ACornerFartherBackThanOneSequenceTellsThePlaceAlongAStraight) {
  // Twice 60 m to a bend of 20 m radius and a straight beyond it, the second
  // time up to 240 m, with an estimate that is 25 m too far along the straight.
  const auto go = [](double straight, double too_far,
                     std::vector<Pose>* poses) {
    for (double s = -60.0; s < 0.0; s += 1.0) poses->push_back({s, too_far});
    for (double angle = 0.0; angle < 0.5 * kPi; angle += 0.05) {
      poses->push_back({20.0 * std::sin(angle),
                        20.0 * (1.0 - std::cos(angle)) + too_far, 0.0, angle});
    }
    for (double s = 20.0; s <= straight; s += 1.0) {
      poses->push_back({20.0, s + too_far, 0.0, 0.5 * kPi});
    }
  };
  std::vector<Pose> poses;
  go(500.0, 0.0, &poses);
  const std::size_t second = poses.size();
  go(240.0, 25.0, &poses);
  std::vector<PoseSample> samples = WithDeviations(poses, 1.0, 1e-4);
  for (std::size_t i = second; i < samples.size(); ++i) {
    for (int k : {0, 1}) samples[i].covariance(k, k) = 30.0 * 30.0;
  }
  const Drive drive = Driven(samples);
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.verdict, Verdict::kAccepted);
  EXPECT_GT(best.relative->overlap_meters, 250.0);
  EXPECT_NEAR(drive.graph().node(best.matched).pose.y, 240.0, 4.0);
  EXPECT_GT(best.relative->probability, 0.8);
}

TEST(SearchRelativeTest, AnEndFarOutsideItsUncertaintyIsRejectedByTheGate) {
  // The estimator has slipped 60 m sideways between the laps, unnoticed.
  std::vector<Pose> poses = Ring(1600.0);
  for (std::size_t i = 1200; i < poses.size(); ++i) poses[i].y += 60.0;
  const Drive drive = Driven(poses);
  SearchOptions options;
  options.use_belief = false;
  // So improbable that only an exhaustive search finds it.
  EXPECT_EQ(Find(drive, options).empty_reason, EmptyReason::kNoProbablePlace);
  options.exhaustive = true;
  const CandidateSet set = Find(drive, options);
  ASSERT_FALSE(set.candidates.empty());
  EXPECT_EQ(set.nodes_pruned, 0);
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.verdict, Verdict::kRejectedByGate);
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kRejected);
  EXPECT_GT(best.relative->squared_end_difference,
            best.difference->gate.threshold);
}

TEST(SearchRelativeTest, TwoPlacesAsGoodAreAmbiguous) {
  // Two equal courses 3 km from each other; then, with the vehicle lost between
  // them, the same shape a third time.
  std::vector<Pose> poses;
  for (const double x : {0.0, 3000.0, 1500.0}) {
    for (Pose pose : Ring(x == 1500.0 ? 500.0 : 1200.0)) {
      pose.x += x;
      poses.push_back(pose);
    }
  }
  std::vector<PoseSample> samples = WithDeviations(poses, 1.0, 1e-4);
  for (std::size_t i = samples.size() - 501; i < samples.size(); ++i) {
    for (int k : {0, 1}) samples[i].covariance(k, k) = 1500.0 * 1500.0;
  }
  const Drive drive = Driven(samples, IndependentSettings());
  SearchOptions options;
  options.acceptance_probability = 0.6;
  const CandidateSet set = Find(drive, options);
  ASSERT_GE(set.candidates.size(), 2u);
  for (int k : {0, 1}) {
    const Candidate& candidate = set.candidates[static_cast<std::size_t>(k)];
    EXPECT_EQ(candidate.verdict, Verdict::kAmbiguous) << k;
    EXPECT_EQ(candidate.difference->gate.verdict, GateVerdict::kAccepted);
    EXPECT_EQ(candidate.relative->path_gate.verdict, GateVerdict::kAccepted);
    ASSERT_TRUE(candidate.relative->odds_to_runner_up);
    EXPECT_GT(*candidate.relative->odds_to_runner_up, 0.5);
    EXPECT_LT(*candidate.relative->odds_to_runner_up, 2.0);
  }
  EXPECT_NEAR(std::abs(drive.graph().node(set.candidates[0].matched).pose.x -
                       drive.graph().node(set.candidates[1].matched).pose.x),
              3000.0, 4.0);
}

TEST(SearchRelativeTest, TwoPassesOfOnePlaceAreBothAccepted) {
  const Drive drive = Driven(Ring(2750.0));
  SearchOptions options;
  options.acceptance_probability = 0.9;
  const CandidateSet set = Find(drive, options);
  ASSERT_GE(set.candidates.size(), 2u);
  EXPECT_NEAR(std::abs(TravelledAt(drive, set.candidates[0]) -
                       TravelledAt(drive, set.candidates[1])),
              RingMeters(drive), 4.0);
  for (int k : {0, 1}) {
    const Candidate& candidate = set.candidates[static_cast<std::size_t>(k)];
    EXPECT_EQ(candidate.verdict, Verdict::kAccepted) << k;
    EXPECT_GT(candidate.relative->probability, 0.9) << k;
  }
}

TEST(SearchRelativeTest, AStraightRoadUnderHugeCovariancesIsUninformative) {
  // Any node of the straight is within the gate.
  const Drive drive =
      Driven(WithDeviations(Trip().Straight(1500.0).poses(), 1000.0, 1.0),
             IndependentSettings());
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  for (const Candidate& candidate : set.candidates) {
    EXPECT_EQ(candidate.verdict, Verdict::kUninformative);
    EXPECT_EQ(candidate.difference->gate.verdict, GateVerdict::kAccepted);
  }
  EXPECT_GT(*set.new_place_probability, 0.6);
}

// Once along a winding road, then from 300 m to 600 m along it again with
// headings that are off, this way or that.
std::vector<PoseSample> AlongAgain(double radians) {
  std::vector<Pose> poses = Trip().Winding(0.0, 800.0).poses();
  std::mt19937_64 random(7);
  for (std::size_t i = 300; i < 600; ++i) {
    Pose pose = poses[i];
    pose.heading += random() % 2 == 0 ? radians : -radians;
    poses.push_back(pose);
  }
  return WithDeviations(poses, 3.0, 0.002);
}

TEST(SearchRelativeTest, AShapeThatStraysTooFarIsRejectedByShape) {
  DriveSettings settings = IndependentSettings();
  settings.search.shape.tolerance.heading_radians = 0.02;
  settings.search.shape.correlation_meters = 10.0;
  settings.search.gate_probability = 0.5;
  const CandidateSet within = Find(Driven(AlongAgain(0.02), settings));
  ASSERT_FALSE(within.candidates.empty());
  EXPECT_EQ(within.candidates[0].verdict, Verdict::kAccepted);
  // Straying farther, the road is still recognised, but not as the same one,
  // until it is not recognised at all.
  int recognised = 0;
  for (const double radians : {0.036, 0.037, 0.038, 0.039, 0.04, 0.041}) {
    const CandidateSet beyond = Find(Driven(AlongAgain(radians), settings));
    ASSERT_FALSE(beyond.candidates.empty());
    const Candidate& best = beyond.candidates[0];
    EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kAccepted);
    if (best.relative->path_gate.verdict != GateVerdict::kRejected) continue;
    ++recognised;
    EXPECT_GT(best.relative->log_likelihood_ratio, 0.0);
    EXPECT_GT(best.relative->path_gate.squared_mahalanobis,
              best.relative->path_gate.threshold);
    EXPECT_EQ(best.verdict, Verdict::kRejectedByShape);
  }
  EXPECT_GE(recognised, 2);
}

TEST(SearchRelativeTest, AnEndAtTheEdgeOfTheGateNeedsAShapeThatSpeaksForIt) {
  // A straight beside another, 2.5 standard deviations off, with nothing in the
  // shape to make up for it.
  const Drive drive = Driven(
      WithDeviations(
          Trip().Straight(800.0).JumpTo({300.0, 150.0}).Straight(250.0).poses(),
          60.0 / std::sqrt(2.0), 0.03),
      IndependentSettings());
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kAccepted);
  EXPECT_EQ(best.relative->path_gate.verdict, GateVerdict::kAccepted);
  // Had the two ends coincided, a road that is joined just there would still be
  // improbable.
  EXPECT_EQ(best.verdict, Verdict::kUninformative);
}

TEST(SearchRelativeTest, NothingIsInventedWhereAllIsIllConditioned) {
  // Dead reckoning cannot become more certain: where it claims to, the
  // covariance of every difference is indefinite.
  std::vector<Pose> poses = Ring(1600.0);
  // A step that could be one back by as much as was uncertain.
  constexpr std::ptrdiff_t kCertain = 1460;
  poses.erase(poses.begin() + kCertain, poses.begin() + kCertain + 60);
  std::vector<PoseSample> samples = WithDeviations(poses, 100.0, 100.0);
  for (std::size_t i = kCertain; i < samples.size(); ++i) {
    for (int k : {0, 1, 3}) samples[i].covariance(k, k) = 1e-4;
  }
  Drive drive({});
  drive.Append(samples, 1);
  for (const AlignmentKind alignment :
       {AlignmentKind::kRelative, AlignmentKind::kComposite}) {
    for (const bool exhaustive : {false, true}) {
      SearchOptions options;
      options.alignment = alignment;
      options.exhaustive = exhaustive;
      const CandidateSet set = Find(drive, options);
      EXPECT_EQ(set.empty_reason, EmptyReason::kNoAlignment);
      EXPECT_FALSE(set.new_place_probability.has_value());
      EXPECT_TRUE(set.candidates.empty());
    }
  }
}

// A second lap whose estimator is overconfident, so that hardly anything but
// the tolerance allows for a difference.
std::vector<PoseSample> SureSecondLap() {
  std::vector<PoseSample> samples =
      oracle::WithCovariances(Ring(1600.0), LittleNoise());
  for (PoseSample& sample : samples) {
    for (double& value : sample.covariance.upper) value *= 1e-2;
  }
  return samples;
}

// Turns the headings that the last node's depends on, and no other's.
void TurnLastNode(double radians, std::vector<PoseSample>* samples) {
  const Drive drive = Driven(*samples);
  const NodeIndex last = drive.graph().size() - 1;
  for (std::size_t i = drive.graph().node(last).sequence - 1;
       i < samples->size(); ++i) {
    (*samples)[i].pose.heading += radians;
  }
  const Drive turned = Driven(*samples);
  ASSERT_EQ(turned.graph().size() - 1, last);
  EXPECT_EQ(turned.graph().node(last - 1).pose.heading,
            drive.graph().node(last - 1).pose.heading);
}

TEST(SearchRelativeTest, OneNoisyEndPoseDoesNotReject) {
  std::vector<PoseSample> samples = SureSecondLap();
  EXPECT_EQ(Find(Driven(samples)).candidates[0].difference->gate.verdict,
            GateVerdict::kAccepted);
  TurnLastNode(0.32, &samples);
  const Drive drive = Driven(samples);
  const CandidateSet set = Find(drive);
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kRejected);
  EXPECT_LT(best.relative->squared_end_difference,
            best.difference->gate.threshold);
  EXPECT_EQ(best.verdict, Verdict::kAccepted);
  EXPECT_NEAR(TravelledAt(drive, best), 1600.0 - RingMeters(drive), 2.5);
}

TEST(SearchRelativeTest, OnePoseOnAnOldRoadIsNotAccepted) {
  // The recent path comes round a bend and touches an old road for one pose,
  // exactly.
  Trip trip;
  trip.Straight(800.0);
  const Pose on_old = trip.poses()[500];
  Trip bend(on_old);
  bend.Turn(-170.0, 60.0);
  std::vector<Pose> poses = trip.poses();
  // The bend backwards ends at the old road.
  for (std::size_t i = bend.poses().size(); i-- > 0;) {
    Pose pose = bend.poses()[i];
    pose.x = 2.0 * on_old.x - pose.x;
    pose.heading = WrapHeading(-pose.heading);
    poses.push_back(pose);
  }
  const Drive drive =
      Driven(WithDeviations(poses, 60.0, 0.05), IndependentSettings());
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  for (const Candidate& candidate : set.candidates) {
    EXPECT_NE(candidate.verdict, Verdict::kAccepted);
    EXPECT_LT(candidate.relative->overlap_meters, 60.0);
  }
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.difference->gate.verdict, GateVerdict::kAccepted);
}

TEST(SearchRelativeTest, TheOppositeDirectionIsFoundOnlyWhenAsked) {
  Trip trip;
  trip.Winding(0.0, 700.0);
  std::vector<Pose> poses = trip.poses();
  // Round a loop and back the same road.
  trip.Turn(-60.0, 20.0).Turn(300.0, 20.0).Turn(-60.0, 20.0);
  poses = trip.poses();
  for (std::size_t i = 700; i-- > 300;) {
    Pose pose = trip.poses()[i];
    pose.heading = WrapHeading(pose.heading + kPi);
    poses.push_back(pose);
  }
  const Drive drive = Driven(poses);
  SearchOptions options;
  for (const Candidate& candidate : Find(drive, options).candidates) {
    EXPECT_EQ(candidate.direction, Direction::kSame);
    EXPECT_NE(candidate.verdict, Verdict::kAccepted);
  }
  for (const SearchDirection direction :
       {SearchDirection::kOpposite, SearchDirection::kEither}) {
    options.direction = direction;
    const CandidateSet set = Find(drive, options);
    ASSERT_FALSE(set.candidates.empty());
    const Candidate& best = set.candidates[0];
    EXPECT_EQ(best.direction, Direction::kOpposite);
    EXPECT_EQ(best.verdict, Verdict::kAccepted);
    EXPECT_NEAR(TravelledAt(drive, best), 300.0, 3.0);
    EXPECT_NEAR(best.difference->difference.heading, 0.0, 0.1);
    // The history is walked forward while the recent path is walked back.
    EXPECT_LT(best.path.back().second, best.path.front().second);
    EXPECT_GT(best.relative->overlap_meters, 140.0);
  }
}

TEST(SearchRelativeTest, AnOldRoadJoinedSixtyMetersAgoIsFound) {
  // Off the old road, and back on it from the side.
  Trip old_road;
  old_road.Winding(0.0, 600.0);
  std::vector<Pose> poses = old_road.poses();
  Trip joining(old_road.poses()[240]);
  joining.Straight(150.0);
  for (std::size_t i = joining.poses().size(); i-- > 1;) {
    // Backwards along a straight that leads into the old road at 240 m.
    Pose pose = joining.poses()[i];
    const Pose& at = old_road.poses()[240];
    pose.x = 2.0 * at.x - pose.x;
    pose.y = 2.0 * at.y - pose.y;
    poses.push_back(pose);
  }
  for (std::size_t i = 240; i <= 300; ++i) poses.push_back(old_road.poses()[i]);
  const Drive drive =
      Driven(WithDeviations(poses, 15.0, 0.05), IndependentSettings());
  const CandidateSet set = Find(drive);
  ASSERT_FALSE(set.candidates.empty());
  const Candidate& best = set.candidates[0];
  EXPECT_EQ(best.verdict, Verdict::kAccepted);
  EXPECT_NEAR(TravelledAt(drive, best), 300.0, 6.0);
  EXPECT_GE(best.relative->overlap_meters, 50.0);
  EXPECT_LE(best.relative->overlap_meters, 100.0);
  EXPECT_EQ(static_cast<double>(best.path.size() - 1) * 2.0,
            best.relative->overlap_meters);
}

TEST(SearchRelativeTest, AnOverlapGoesOnOverAConfirmedLoopClosure) {
  // The history saw the road in two drives that share 20 m.
  Trip road;
  road.Winding(0.0, 600.0);
  std::vector<Pose> poses;
  const auto go = [&](std::size_t from, std::size_t to) {
    for (std::size_t i = from; i <= to; ++i) poses.push_back(road.poses()[i]);
  };
  go(0, 320);
  go(300, 600);  // From 320 m back to 300 m: a jump of 20 m, taken below.
  go(200, 400);
  DriveSettings settings = IndependentSettings();
  settings.max_step_meters = 10.0;
  Drive drive(settings);
  ASSERT_EQ(drive.Append(WithDeviations(poses, 3.0, 0.02), 1).jumps.size(), 2u);
  const auto overlap = [&drive] {
    const CandidateSet set = Find(drive);
    // The candidate on the second drive.
    for (const Candidate& candidate : set.candidates) {
      if (candidate.matched > 160) return candidate.relative->overlap_meters;
    }
    return -1.0;
  };
  EXPECT_GE(overlap(), 90.0);
  EXPECT_LE(overlap(), 110.0);
  // 310 m along the road, in either drive.
  drive.AddLoopClosure(332, 311, 2);
  EXPECT_GE(overlap(), 144.0);
}

TEST(SearchRelativeTest, RejectedPairsAreNotOfferedUntilTheRejectionGoes) {
  Drive drive = Driven(Ring(1600.0));
  const CandidateSet before = Find(drive);
  const Candidate& best = before.candidates[0];
  const auto sequence = [&drive](NodeIndex i) {
    const Node& node = drive.graph().node(i);
    return node.sequence + (node.fraction > 0.0 ? 1 : 0);
  };
  const std::uint64_t query = sequence(*before.query);
  const std::uint64_t matched = sequence(best.matched);
  drive.AddRejection(query, matched, 2);
  EXPECT_EQ(drive.revision(), 2u);
  EXPECT_EQ(drive.consistency().rejected, 1);
  const double separation = drive.settings().search.candidate_separation_meters;
  for (const AlignmentKind alignment :
       {AlignmentKind::kRelative, AlignmentKind::kComposite}) {
    SearchOptions options;
    options.alignment = alignment;
    for (const Candidate& candidate : Find(drive, options).candidates) {
      EXPECT_GE(
          std::abs(TravelledAt(drive, candidate) - TravelledAt(drive, best)),
          separation - 2.0);
    }
  }
  // Queries farther away than the separation are not affected.
  const NodeIndex earlier = *before.query - 10;
  const auto other =
      Search(&drive).At(earlier, drive.settings().search, nullptr);
  EXPECT_EQ(other->candidates[0].verdict, Verdict::kAccepted);
  EXPECT_NEAR(static_cast<double>(other->candidates[0].matched),
              static_cast<double>(best.matched - 10), 1.0);

  // Twice rejected, once taken back: still rejected.
  drive.AddRejection(query, matched, 3);
  drive.RemoveRejection(query, matched, 4);
  EXPECT_NE(Find(drive).candidates[0].matched, best.matched);
  drive.RemoveRejection(query, matched, 5);
  EXPECT_EQ(drive.consistency().rejected, 0);
  const CandidateSet after = Find(drive);
  ASSERT_EQ(after.candidates.size(), before.candidates.size());
  for (std::size_t i = 0; i < after.candidates.size(); ++i) {
    EXPECT_EQ(after.candidates[i].matched, before.candidates[i].matched);
    EXPECT_EQ(after.candidates[i].score, before.candidates[i].score);
  }
}

TEST(SearchRelativeTest, CompositeAnswersDoNotDependOnTheRelativeSettings) {
  const Drive drive = Driven(Ring(1600.0));
  SearchOptions options;
  options.alignment = AlignmentKind::kComposite;
  const CandidateSet plain = Find(drive, options);
  options.shape.tolerance = {7.0, 0.5};
  options.shape.correlation_meters = 3.0;
  options.road_spacing_meters = 50.0;
  options.acceptance_probability = 0.99;
  const CandidateSet other = Find(drive, options);
  EXPECT_EQ(plain.new_place_probability, std::nullopt);
  ASSERT_EQ(plain.candidates.size(), other.candidates.size());
  ASSERT_FALSE(plain.candidates.empty());
  for (std::size_t i = 0; i < plain.candidates.size(); ++i) {
    EXPECT_EQ(plain.candidates[i].score, other.candidates[i].score);
    EXPECT_EQ(plain.candidates[i].path, other.candidates[i].path);
    EXPECT_EQ(plain.candidates[i].verdict, other.candidates[i].verdict);
    EXPECT_FALSE(plain.candidates[i].relative);
    EXPECT_EQ(
        plain.candidates[i].verdict == Verdict::kAccepted,
        plain.candidates[i].difference->gate.verdict == GateVerdict::kAccepted);
  }
}

TEST(SearchRelativeTest, APlaceAndANewOneAreTogetherNoMoreThanCertain) {
  std::mt19937_64 random = SeededRandom();
  for (const double factor : {0.1, 1.0, 10.0, 100.0}) {
    std::vector<PoseSample> samples = oracle::WithCovariances(
        oracle::DrawEstimate(Ring(2750.0), LittleNoise(), random),
        LittleNoise());
    for (PoseSample& sample : samples) {
      for (double& value : sample.covariance.upper) value *= factor;
    }
    const Drive drive = Driven(samples);
    SearchOptions options;
    options.direction = SearchDirection::kEither;
    options.max_candidates = 100;
    for (NodeIndex query = 700; query < drive.graph().size(); query += 90) {
      const auto set = Search(&drive).At(query, options, nullptr);
      for (const Candidate& candidate : set->candidates) {
        EXPECT_GE(candidate.relative->probability, 0.0);
        EXPECT_LE(candidate.relative->probability + *set->new_place_probability,
                  1.0 + 1e-12)
            << factor;
      }
    }
  }
}

void ExpectAlike(const CandidateSet& a, const CandidateSet& b,
                 double tolerance) {
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  ASSERT_FALSE(a.candidates.empty());
  EXPECT_EQ(a.query, b.query);
  EXPECT_NEAR(*a.new_place_probability, *b.new_place_probability, tolerance);
  for (std::size_t i = 0; i < a.candidates.size(); ++i) {
    const Candidate& x = a.candidates[i];
    const Candidate& y = b.candidates[i];
    EXPECT_NEAR(x.score, y.score, tolerance * std::max(1.0, std::abs(x.score)));
    EXPECT_EQ(x.matched, y.matched);
    EXPECT_EQ(x.direction, y.direction);
    EXPECT_EQ(x.verdict, y.verdict);
    EXPECT_EQ(x.path, y.path);
    EXPECT_NEAR(x.relative->probability, y.relative->probability, tolerance);
    const double d2 = x.difference->gate.squared_mahalanobis;
    EXPECT_NEAR(d2, y.difference->gate.squared_mahalanobis,
                tolerance * std::max(1.0, d2));
  }
}

TEST(SearchRelativeTest, AnAnswerDoesNotDependOnNodesAfterTheQuery) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = oracle::WithCovariances(
      oracle::DrawEstimate(Ring(2400.0), LittleNoise(), random), LittleNoise());
  const Drive then =
      Driven(std::vector<PoseSample>(samples.begin(), samples.begin() + 1600));
  const Drive later = Driven(samples);
  SearchOptions options;
  options.direction = SearchDirection::kEither;
  const NodeIndex query = then.graph().size() - 1;
  const auto a = Search(&then).At(query, options, nullptr);
  const auto b = Search(&later).At(query, options, nullptr);
  ExpectAlike(*a, *b, 0.0);
}

TEST(SearchRelativeTest, AnAnswerDoesNotDependOnTheFrameOrTheClock) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> here = oracle::WithCovariances(
      oracle::DrawEstimate(Ring(1600.0), LittleNoise(), random), LittleNoise());
  const double angle = 2.4;
  const StateMatrix<3> turn = TurnAbout<3>(angle);
  std::vector<PoseSample> there = here;
  for (PoseSample& sample : there) {
    const StateVector<3> pose = turn * ToVector<3>(sample.pose);
    sample.pose = {pose(0) + 1234.5, pose(1) - 987.6, 0.0,
                   sample.pose.heading + angle};
    sample.covariance = ToCovariance<3>(turn * ToMatrix<3>(sample.covariance) *
                                        turn.transpose());
    sample.stamp_ns = 1'700'000'000'000'000'000 +
                      static_cast<std::int64_t>(sample.sequence) * 100'000'000;
  }
  DriveSettings settings;
  settings.search.direction = SearchDirection::kEither;
  Drive a = Driven(here, settings);
  Drive b = Driven(there, settings);
  ExpectAlike(Find(a), Find(b), 1e-9);
  // With a confirmed closure too.
  const auto lap = static_cast<std::uint64_t>(RingMeters(a));
  a.AddLoopClosure(1300, 1300 - lap, 2);
  b.AddLoopClosure(1300, 1300 - lap, 2);
  ExpectAlike(Find(a), Find(b), 1e-9);
}

TEST(SearchRelativeTest, InflationIsAppliedOnlyWhenTheVehicleSaysSo) {
  // The laps lie 20 m apart, which the covariances call impossible.
  std::vector<Pose> poses = Ring(1900.0);
  for (std::size_t i = 1200; i < poses.size(); ++i) poses[i].y += 20.0;
  DriveSettings settings;
  settings.search.use_belief = false;
  for (const bool apply : {false, true}) {
    settings.apply_inflation = apply;
    Drive drive = Driven(poses, settings);
    const auto lap = static_cast<std::uint64_t>(RingMeters(drive));
    std::uint64_t revision = 1;
    for (std::uint64_t k = 0; k < 10; ++k) {
      drive.AddLoopClosure(1400 + 20 * k, 1400 + 20 * k - lap, ++revision);
    }
    EXPECT_EQ(drive.consistency().confirmed, 10);
    EXPECT_GT(drive.consistency().inflation, 1.5);
    EXPECT_LE(drive.consistency().inflation, 10.0 + 1e-9);
    const CandidateSet set = Find(drive);
    ASSERT_FALSE(set.candidates.empty());
    EXPECT_EQ(set.candidates[0].inflation,
              apply ? drive.consistency().inflation : 1.0);
  }
}

TEST(SearchRelativeTest, AClosureTakenBackLeavesNoTraceInTheConsistency) {
  const std::vector<Pose> poses = Ring(1900.0);
  Drive plain = Driven(poses);
  Drive other = Driven(poses);
  plain.AddLoopClosure(1400, 246, 2);
  plain.AddLoopClosure(1500, 346, 3);
  other.AddLoopClosure(1400, 246, 2);
  other.AddLoopClosure(1450, 1000, 3);  // Wrong, and soon taken back.
  other.AddLoopClosure(1500, 346, 4);
  EXPECT_EQ(other.consistency().confirmed, 3);
  EXPECT_NE(other.consistency().inflation, plain.consistency().inflation);
  other.RemoveLoopClosure(1450, 1000, 5);
  EXPECT_EQ(other.consistency().confirmed, 2);
  EXPECT_EQ(other.consistency().inflation, plain.consistency().inflation);
  EXPECT_EQ(other.consistency().mean_normalized_innovation_squared,
            plain.consistency().mean_normalized_innovation_squared);
  // Other settings result in another estimate from the same closures.
  DriveSettings settings;
  settings.max_inflation = 1.0;
  EXPECT_TRUE(other.ChangeSettings(settings, 6).ok());
  EXPECT_EQ(other.consistency().confirmed, 2);
  EXPECT_EQ(other.consistency().inflation, 1.0);
  EXPECT_TRUE(other.ChangeSettings({}, 7).ok());
  EXPECT_EQ(other.consistency().inflation, plain.consistency().inflation);
}

}  // namespace
}  // namespace revisit::core
