#include "client/trajectory/joined_covariances.h"

#include <cmath>

#include "client/formats/angles.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

// A pose that heads along x of its own frame, with these variances.
LocalPose Claiming(double x, double y, double heading, bool starts = false) {
  LocalPose pose;
  pose.covariance[0] = x;
  pose.covariance[5] = y;
  pose.covariance[15] = heading;
  if (starts) pose.recording_start.emplace();
  return pose;
}

TEST(JoinedCovariancesTest, FirstRecordingKeepsWhatIsStored) {
  JoinedCovariances joined;
  const LocalPose first = Claiming(1.0, 2.0, 0.01, true);
  EXPECT_EQ(joined.Next(first, {}, 0.5), first.covariance);
  const LocalPose next = Claiming(2.0, 3.0, 0.02);
  EXPECT_EQ(joined.Next(next, {5.0, 0.0, 0.0}, 0.5), next.covariance);
}

TEST(JoinedCovariancesTest, NextRecordingGoesOnFromTheEndOfTheLast) {
  JoinedCovariances joined;
  joined.Next(Claiming(4.0, 9.0, 0.01), {10.0, 0.0, 0.0}, 0.0);
  // Its frame is turned to the left; it begins where the last one ended.
  const StateMatrix start = joined.Next(Claiming(0.5, 0.25, 0.001, true),
                                        {10.0, 0.0, 0.0}, 0.5 * kPi);
  EXPECT_NEAR(start[0], 4.0 + 0.25, 1e-12);
  EXPECT_NEAR(start[5], 9.0 + 0.5, 1e-12);
  EXPECT_NEAR(start[15], 0.011, 1e-12);
  // 20 m on along x, the heading of that end swings the pose along y.
  const StateMatrix later =
      joined.Next(Claiming(0.5, 0.25, 0.001), {30.0, 0.0, 0.0}, 0.5 * kPi);
  EXPECT_NEAR(later[0], 4.25, 1e-12);
  EXPECT_NEAR(later[5], 9.5 + 400.0 * 0.01, 1e-12);
  EXPECT_NEAR(later[7], 20.0 * 0.01, 1e-12);
  EXPECT_NEAR(later[7], later[13], 1e-15);
}

TEST(JoinedCovariancesTest, ClaimsNeverShrinkOverManyRecordings) {
  JoinedCovariances joined;
  double last = 0.0;
  for (int run = 0; run < 5; ++run) {
    for (int i = 0; i < 50; ++i) {
      const double variance = 0.01 + 0.001 * i;
      const StateMatrix c =
          joined.Next(Claiming(variance, variance, 1e-6 * (i + 1), i == 0),
                      {2.0 * i, 10.0 * run, 0.0}, 0.3 * run);
      if (i > 0 || run == 0) continue;
      EXPECT_GT(c[0] + c[5], last);
      last = c[0] + c[5];
    }
  }
}

}  // namespace
}  // namespace revisit::client
