#include "client/formats/restart_watch.h"

#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

namespace revisit::client {
namespace {

Sample At(double x, double y, double heading) {
  Sample sample;
  sample.estimate = {x, y, heading};
  return sample;
}

Sample Claiming(Sample sample, double position, double heading) {
  sample.covariance = {position, 0.0, 0.0, position, 0.0, heading};
  return sample;
}

// 40 poses 2 m apart along x, from a first one that is not at the origin.
std::vector<Sample> Straight() {
  std::vector<Sample> samples;
  for (int i = 0; i < 40; ++i) samples.push_back(At(30.0 + 2.0 * i, 5.0, 0.0));
  return samples;
}

// Whether the odometry began anew with `last`, after the way.
bool Restarts(const std::vector<Sample>& way, const Sample& last) {
  RestartWatch watch;
  for (const Sample& sample : way) EXPECT_FALSE(watch.Observe(sample));
  return watch.Observe(last);
}

TEST(RestartWatchTest, LeapBackToTheOriginOrTheFirstPoseIsARestart) {
  EXPECT_TRUE(Restarts(Straight(), At(0.0, 0.0, 0.0)));
  EXPECT_TRUE(Restarts(Straight(), At(30.5, 5.0, 0.1)));
}

TEST(RestartWatchTest, LeapElsewhereOrHeadingElsewhereIsNone) {
  EXPECT_FALSE(Restarts(Straight(), At(60.0, -40.0, 0.0)));
  EXPECT_FALSE(Restarts(Straight(), At(0.0, 0.0, 1.0)));
}

TEST(RestartWatchTest, StepsThatAreUsuallySoLongAreNoLeap) {
  std::vector<Sample> fast;
  for (int i = 0; i < 10; ++i) fast.push_back(At(30.0 * (10 - i), 0.0, 0.0));
  EXPECT_FALSE(Restarts(fast, At(0.0, 0.0, 0.0)));
}

TEST(RestartWatchTest, LeapThatTheEstimatorCallsUncertainIsNoRestart) {
  std::vector<Sample> way = Straight();
  for (Sample& sample : way) sample = Claiming(sample, 0.5, 0.01);
  const Sample origin = At(0.0, 0.0, 0.0);
  EXPECT_FALSE(Restarts(way, Claiming(origin, 25.0, 0.3)));
  EXPECT_TRUE(Restarts(way, Claiming(origin, 0.01, 0.001)));
  // Drivers that write one covariance into each message.
  EXPECT_TRUE(Restarts(way, Claiming(origin, 0.5, 0.01)));
}

TEST(RestartWatchTest, ClaimsThatFallAtTheOriginAreARestartWithoutALeap) {
  std::vector<Sample> lap;
  for (int i = 0; i < 30; ++i) {
    lap.push_back(Claiming(At(30.0 - i, 0.0, 0.0), 4.0 + i, 0.05 + 0.001 * i));
  }
  // 1 m away from the last pose.
  EXPECT_TRUE(Restarts(lap, Claiming(At(0.0, 0.0, 0.0), 0.01, 1e-4)));
  EXPECT_FALSE(Restarts(lap, Claiming(At(0.0, 0.0, 0.0), 40.0, 0.09)));
}

TEST(RestartWatchTest, SecondRestartIsSeenToo) {
  RestartWatch watch;
  int restarts = 0;
  for (int run = 0; run < 3; ++run) {
    for (int i = 0; i < 40; ++i) restarts += watch.Observe(At(2.0 * i, 0, 0));
  }
  EXPECT_EQ(restarts, 2);
}

// Odometry as `ros2 topic echo --csv` prints it, of 40 poses along x, twice.
std::string TwoRunsOfRos() {
  std::string text;
  for (int i = 0; i < 80; ++i) {
    absl::StrAppend(&text, 1600000000 + i, ",0,odom,base_link,", 2.0 * (i % 40),
                    ".0,0.0,0.0,0.0,0.0,0.0,1.0");
    for (int k = 0; k < 78; ++k) absl::StrAppend(&text, ",0.0");
    text += "\n";
  }
  return text;
}

TEST(RestartWatchTest, OdometryOfRosIsMarkedAndOtherFilesAreNot) {
  const auto odometry = ReadText(TwoRunsOfRos());
  ASSERT_TRUE(odometry.ok()) << odometry.status();
  ASSERT_EQ(odometry->size(), 80u);
  for (std::size_t i = 0; i < odometry->size(); ++i) {
    EXPECT_EQ((*odometry)[i].restarts, i == 40) << i;
  }
  std::string drive = "t_s,est_x,est_y,est_yaw\n";
  for (int i = 0; i < 80; ++i) {
    absl::StrAppend(&drive, i, ",", 2.0 * (i % 40), ",0,0\n");
  }
  const auto samples = ReadText(drive);
  ASSERT_TRUE(samples.ok()) << samples.status();
  for (const Sample& sample : *samples) EXPECT_FALSE(sample.restarts);
}

TEST(TumReaderTest, CommentThatStatesARecordingGoesWithTheNextPose) {
  const auto samples = ReadText(
      "# a trajectory\n"
      "0.0 0 0 0 0 0 0 1\n"
      "# recording {\"label\":\"b\",\"unknown\":true}\n"
      "# another comment\n"
      "1.0 1 0 0 0 0 0 1\n"
      "2.0 2 0 0 0 0 0 1\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 3u);
  EXPECT_FALSE((*samples)[0].recording_start.has_value());
  EXPECT_EQ((*samples)[1].recording_start,
            "{\"label\":\"b\",\"unknown\":true}");
  EXPECT_FALSE((*samples)[2].recording_start.has_value());
}

}  // namespace
}  // namespace revisit::client
