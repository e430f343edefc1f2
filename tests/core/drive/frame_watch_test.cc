#include "core/drive/frame_watch.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/findings.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/core/drive/drives.h"

namespace revisit::core {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

// What an odometry claims: its error is carried on, and each metre adds some.
class GrowingClaims {
 public:
  explicit GrowingClaims(double position = 0.1, double heading = 0.01)
      : xx_(position * position), yy_(xx_), hh_(heading * heading) {}

  void Step(double dx, double dy) {
    const double meters = std::hypot(dx, dy);
    xy_ += dx * xh_ - dy * yh_ - dx * dy * hh_;
    xx_ += -2.0 * dy * xh_ + dy * dy * hh_ + 0.01 * meters;
    yy_ += 2.0 * dx * yh_ + dx * dx * hh_ + 0.01 * meters;
    xh_ -= dy * hh_;
    yh_ += dx * hh_;
    hh_ += 4e-6 * meters;
  }
  // How uncertain a new start is.
  void Add(double position, double heading) {
    xx_ += position * position;
    yy_ += position * position;
    hh_ += heading * heading;
  }

  Covariance covariance() const {
    Covariance s;
    s(0, 0) = xx_;
    s(0, 1) = xy_;
    s(1, 1) = yy_;
    s(2, 2) = 1.0;
    s(0, 3) = xh_;
    s(1, 3) = yh_;
    s(3, 3) = hh_;
    return s;
  }

 private:
  double xx_;
  double yy_;
  double xy_ = 0.0;
  double xh_ = 0.0;
  double yh_ = 0.0;
  double hh_;
};

// A vehicle's recordings, one behind the other.
class Stretches {
 public:
  // Begins anew, with small claims.
  Stretches& Restart(const std::vector<Pose>& poses) {
    claims_ = GrowingClaims();
    restarted_at_ = samples_.size();
    return Send(poses);
  }
  // Goes on as if the vehicle had driven to the first of these poses.
  Stretches& Continue(const std::vector<Pose>& poses) { return Send(poses); }
  // The same, but says how uncertain the first of these poses is.
  Stretches& State(double position, double heading,
                   const std::vector<Pose>& poses) {
    added_ = {position, heading};
    return Send(poses);
  }

  const std::vector<PoseSample>& samples() const { return samples_; }
  std::vector<PoseSample>& samples() { return samples_; }

 private:
  Stretches& Send(const std::vector<Pose>& poses) {
    for (const Pose& pose : poses) {
      if (samples_.size() != restarted_at_) {
        const Pose& before = samples_.back().pose;
        claims_.Step(pose.x - before.x, pose.y - before.y);
      }
      claims_.Add(added_.first, added_.second);
      added_ = {};
      PoseSample sample;
      sample.sequence = samples_.size() + 1;
      sample.stamp_ns =
          static_cast<std::int64_t>(sample.sequence) * 1'000'000'000;
      sample.pose = pose;
      sample.covariance = claims_.covariance();
      samples_.push_back(sample);
    }
    return *this;
  }

  GrowingClaims claims_;
  std::size_t restarted_at_ = 0;
  std::pair<double, double> added_;
  std::vector<PoseSample> samples_;
};

std::vector<NewFrame> FramesIn(const std::vector<Finding>& findings) {
  std::vector<NewFrame> frames;
  for (const Finding& finding : findings) {
    EXPECT_EQ(finding.code == FindingCode::kNewFrame,
              finding.frame.has_value());
    if (finding.frame) frames.push_back(*finding.frame);
  }
  return frames;
}

// The new frames of which a drive tells while these poses come in batches.
std::vector<NewFrame> Told(const std::vector<PoseSample>& samples,
                           std::size_t batch = 64,
                           const DriveSettings& settings = {}) {
  Drive drive(settings);
  std::vector<NewFrame> told;
  std::uint64_t revision = 0;
  for (std::size_t i = 0; i < samples.size(); i += batch) {
    const auto begin = samples.begin() + static_cast<std::ptrdiff_t>(i);
    const auto end = samples.begin() + static_cast<std::ptrdiff_t>(
                                           std::min(i + batch, samples.size()));
    const AppendResult result = drive.Append({begin, end}, ++revision);
    for (const NewFrame& frame : FramesIn(result.findings)) {
      told.push_back(frame);
    }
  }
  const std::vector<NewFrame> last = FramesIn(drive.findings());
  EXPECT_EQ(last.empty(), told.empty());
  if (!last.empty() && !told.empty()) {
    EXPECT_EQ(last[0].sequence, told.back().sequence);
  }
  return told;
}

std::vector<std::uint64_t> Sequences(const std::vector<NewFrame>& frames) {
  std::vector<std::uint64_t> sequences;
  for (const NewFrame& frame : frames) sequences.push_back(frame.sequence);
  return sequences;
}

// Poses every metre: 700 m that end 62 m from their start.
std::vector<Pose> Town() {
  return Trip()
      .Straight(250)
      .Turn(90, 20)
      .Straight(50)
      .Turn(90, 20)
      .Straight(232)
      .poses();
}

std::vector<Pose> Road(double meters, const Pose& start = {}) {
  return Trip(start).Winding(0, meters).poses();
}

TEST(FrameWatchTest, SeesClaimsThatFallOverALeapThatIsBridged) {
  const std::vector<Pose> town = Town();
  const std::uint64_t second = town.size() + 1;
  const Stretches sent = Stretches().Restart(town).Restart(Town());
  const std::vector<NewFrame> told = Told(sent.samples());
  ASSERT_THAT(Sequences(told), ElementsAre(second));
  EXPECT_TRUE(told[0].claims_fall);
  const double leap = std::hypot(town.back().x, town.back().y);
  ASSERT_GT(leap, 60.0);
  ASSERT_LT(leap, 100.0);
  EXPECT_NEAR(told[0].meters, leap, 6.0);
  EXPECT_NEAR(told[0].after.radians, 0.01, 0.001);
  EXPECT_GT(told[0].before.meters, 5.0 * told[0].after.meters);
  EXPECT_GT(told[0].before.radians, 2.0 * told[0].after.radians);
  ASSERT_TRUE(told[0].nanoseconds);
  EXPECT_NEAR(static_cast<double>(*told[0].nanoseconds), 3e9, 2e9);
}

TEST(FrameWatchTest, TellsTheSameHoweverThePosesCome) {
  const Stretches sent =
      Stretches().Restart(Town()).Restart(Road(400)).Restart(Town());
  const std::vector<std::uint64_t> at_once = Sequences(Told(sent.samples()));
  EXPECT_THAT(at_once, ElementsAre(Town().size() + 1,
                                   Town().size() + Road(400).size() + 1));
  EXPECT_EQ(Sequences(Told(sent.samples(), 1)), at_once);
  // Of several that one batch shows, the last is told.
  EXPECT_EQ(Sequences(Told(sent.samples(), 100'000)),
            std::vector<std::uint64_t>{at_once.back()});
}

TEST(FrameWatchTest, SeesClaimsThatFallAtAJump) {
  const std::vector<Pose> first = Road(500);
  const Stretches sent = Stretches().Restart(first).Restart(Road(300));
  EXPECT_THAT(Sequences(Told(sent.samples())), ElementsAre(first.size() + 1));
}

TEST(FrameWatchTest, ClaimsThatFallWhereThePoseGoesOnWereGivenUp) {
  const std::vector<Pose> first =
      Trip().Straight(250).Turn(180, 20).Straight(248).poses();
  const Stretches sent = Stretches().Restart(first).Restart(
      Trip(first.back()).Straight(100).poses());
  EXPECT_THAT(Told(sent.samples()), IsEmpty());
  Drive drive((DriveSettings()));
  const AppendResult result = drive.Append(sent.samples(), 1);
  ASSERT_EQ(result.findings.size(), 1u);
  EXPECT_EQ(result.findings[0].code, FindingCode::kCovariancesReset);
  ASSERT_TRUE(result.findings[0].reset);
  const ClaimsReset& reset = *result.findings[0].reset;
  // The first pose behind stands where the last one before was.
  EXPECT_EQ(reset.sequence, first.size() + 2);
  EXPECT_GT(reset.before.meters, 5.0 * reset.after.meters);
  EXPECT_GT(reset.before.radians, 2.0 * reset.after.radians);
}

TEST(FrameWatchTest, TellsOfAShortLeapOnce) {
  for (int meters = 2; meters < 20; ++meters) {
    const std::vector<Pose> first = Town();
    Pose start = first.back();
    start.y += meters;
    const Stretches sent =
        Stretches().Restart(first).Restart(Trip(start).Straight(100).poses());
    EXPECT_THAT(Sequences(Told(sent.samples(), 1)),
                ElementsAre(first.size() + 1))
        << meters;
  }
}

TEST(FrameWatchTest, SeesAReturnToTheStartThoughClaimsGrowOn) {
  const std::vector<Pose> first = Town();
  const Stretches sent = Stretches().Restart(first).Continue(Road(300));
  const std::vector<NewFrame> told = Told(sent.samples());
  ASSERT_THAT(Sequences(told), ElementsAre(first.size() + 1));
  EXPECT_FALSE(told[0].claims_fall);
  // From another place than the origin: to its own start, and to the origin.
  const Pose away{300.0, 200.0, 0.0, 1.0};
  for (const Pose& start : {away, Pose()}) {
    const Stretches other =
        Stretches().Restart(Road(400, away)).Continue(Road(300, start));
    EXPECT_THAT(Sequences(Told(other.samples())),
                ElementsAre(Road(400).size() + 1));
  }
  // To neither.
  const Stretches goes_on = Stretches().Restart(Road(400)).Continue(
      Road(300, {300.0, 200.0, 0.0, 1.0}));
  EXPECT_THAT(Told(goes_on.samples()), IsEmpty());
}

TEST(FrameWatchTest, SeesAReturnThoughClaimsStayAsTheyAre) {
  std::vector<Pose> poses = Town();
  const std::uint64_t second = poses.size() + 1;
  for (const Pose& pose : Town()) poses.push_back(pose);
  EXPECT_THAT(Sequences(Told(WithDeviations(poses, 0.5, 0.02))),
              ElementsAre(second));
}

TEST(FrameWatchTest, IsSilentWhereTheStartIsSaidToBeUncertain) {
  for (const auto& [position, heading] :
       {std::make_pair(10.0, 0.01), {0.1, 0.2}, {10.0, 0.2}}) {
    const Stretches sent =
        Stretches().Restart(Town()).State(position, heading, Road(300));
    EXPECT_THAT(Told(sent.samples()), IsEmpty()) << position << ' ' << heading;
  }
}

TEST(FrameWatchTest, SeesNothingInOneRecording) {
  // Laps, past the start and over it, with a pose for each metre and for each
  // 25 m, and with a stretch of which no pose was sent.
  std::vector<Pose> laps =
      Trip().Straight(400).Turn(180, 60).Straight(400).Turn(180, 60).poses();
  for (int lap = 0; lap < 2; ++lap)
    laps.insert(laps.end(), laps.begin(), laps.end());
  EXPECT_THAT(Told(Stretches().Restart(laps).samples()), IsEmpty());
  std::vector<Pose> sparse;
  for (std::size_t i = 0; i < laps.size(); i += 25) sparse.push_back(laps[i]);
  EXPECT_THAT(Told(Stretches().Restart(sparse).samples()), IsEmpty());
  for (const int lost : {60, 150, 400}) {
    std::vector<Pose> some = laps;
    some.erase(some.begin() + 500, some.begin() + 500 + lost);
    EXPECT_THAT(Told(Stretches().Restart(some).samples()), IsEmpty()) << lost;
  }
}

TEST(FrameWatchTest, ACompassMayKeepTheHeadingWhereTheVehicleLeaps) {
  const auto with_compass = [](const std::vector<Pose>& next) {
    Stretches sent = Stretches().Restart(Town()).Restart(next);
    for (PoseSample& sample : sent.samples()) {
      sample.covariance(0, 3) = sample.covariance(1, 3) = 0.0;
      sample.covariance(3, 3) = 1e-4;
    }
    return sent.samples();
  };
  EXPECT_THAT(Sequences(Told(with_compass(Road(300, {50, 200, 0, 0})))),
              ElementsAre(Town().size() + 1));
  // A fix, which leads on where the vehicle is, is no new frame.
  const std::vector<Pose> town = Town();
  EXPECT_THAT(Told(with_compass(Trip(town.back()).Straight(300).poses())),
              IsEmpty());
}

TEST(FrameWatchTest, OnlyClaimsThatAreToGrowTell) {
  const Stretches sent = Stretches().Restart(Town()).Restart(Town());
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  EXPECT_THAT(Told(sent.samples(), 64, settings), IsEmpty());
  settings.search.correlation_model = CorrelationModel::kCorrelatedFixes;
  EXPECT_THAT(Told(sent.samples(), 64, settings), IsEmpty());
}

TEST(FrameWatchTest, FollowsTheSettingsOfTheVehicle) {
  const Stretches sent = Stretches().Restart(Town()).Restart(Town());
  DriveSettings settings;
  Drive drive(settings);
  drive.Append(sent.samples(), 1);
  EXPECT_EQ(FramesIn(drive.findings()).size(), 1u);
  settings.search.correlation_model = CorrelationModel::kIndependent;
  Drive independent(settings);
  independent.Append(sent.samples(), 1);
  EXPECT_THAT(FramesIn(independent.findings()), IsEmpty());
}

TEST(FrameWatchTest, WhereClaimsDoNotGrowAtAllTheirFallIsNotTold) {
  // Fixes whose claims go up and down, taken for those of dead reckoning.
  std::vector<PoseSample> samples = WithDeviations(Road(3000), 1.0, 0.02);
  for (PoseSample& sample : samples) {
    const double scale =
        1.0 + 2.9 * std::sin(0.1 * static_cast<double>(sample.sequence));
    for (double& entry : sample.covariance.upper) entry *= scale * scale + 0.01;
  }
  for (PoseSample& sample : samples) {
    if (sample.sequence % 500 >= 250) continue;
    for (double& entry : sample.covariance.upper) entry *= 100.0;
  }
  Drive drive((DriveSettings()));
  drive.Append(samples, 1);
  const std::vector<Finding> findings = drive.findings();
  ASSERT_EQ(findings.size(), 1u);
  EXPECT_EQ(findings[0].code, FindingCode::kCovariancesDoNotGrow);
}

// A drive that has dropped 30 poses: the last 20 of the `first` ones that were
// sent before a restart, and those right behind it.
Drive DroppedAround(std::size_t first, const Stretches& sent) {
  const auto begin = sent.samples().begin();
  const auto cut = static_cast<std::ptrdiff_t>(first) - 20;
  Drive drive((DriveSettings()));
  drive.Append({begin, begin + cut}, 1);
  DroppedStretch stretch;
  stretch.first_sequence = static_cast<std::uint64_t>(cut) + 1;
  stretch.last_sequence = stretch.first_sequence + 29;
  stretch.travelled_meters = 30.0;
  drive.Skip(stretch, 2);
  drive.Append({begin + cut + 30, sent.samples().end()}, 3);
  return drive;
}

// The drive as it is loaded from its first part and the rest.
Drive Loaded(const Drive& drive) {
  Drive loaded((DriveSettings()));
  EXPECT_GE(drive.whole_parts(), 1u);
  EXPECT_TRUE(loaded.LoadPart(drive.SavePart(0)));
  EXPECT_TRUE(loaded.LoadRest(drive.SaveRest(1)));
  return loaded;
}

TEST(FrameWatchTest, NothingIsJudgedOverPosesThatWereDropped) {
  const Stretches sent = Stretches().Restart(Town()).Restart(Town());
  const Drive drive = DroppedAround(Town().size(), sent);
  EXPECT_THAT(FramesIn(drive.findings()), IsEmpty());
}

TEST(FrameWatchTest, ADriveThatIsLoadedTellsTheSame) {
  const Stretches sent = Stretches().Restart(Road(3000)).Restart(Road(15'000));
  Drive drive((DriveSettings()));
  drive.Append(sent.samples(), 1);
  const std::vector<NewFrame> frames = FramesIn(drive.findings());
  ASSERT_EQ(frames.size(), 1u);
  const std::vector<NewFrame> again = FramesIn(Loaded(drive).findings());
  ASSERT_EQ(again.size(), 1u);
  EXPECT_EQ(again[0].sequence, frames[0].sequence);
  EXPECT_EQ(again[0].meters, frames[0].meters);
  EXPECT_EQ(again[0].before.meters, frames[0].before.meters);
  EXPECT_EQ(again[0].after.radians, frames[0].after.radians);
  EXPECT_EQ(again[0].nanoseconds, frames[0].nanoseconds);
}

TEST(FrameWatchTest, ADriveThatIsLoadedJudgesNothingOverPosesThatWereDropped) {
  const Stretches sent = Stretches().Restart(Road(3000)).Restart(Road(15'000));
  const Drive drive = DroppedAround(Road(3000).size(), sent);
  ASSERT_THAT(FramesIn(drive.findings()), IsEmpty());
  EXPECT_THAT(FramesIn(Loaded(drive).findings()), IsEmpty());
}

}  // namespace
}  // namespace revisit::core
