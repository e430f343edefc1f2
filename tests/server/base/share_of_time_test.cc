#include "server/base/share_of_time.h"

#include <gtest/gtest.h>

#include <chrono>

namespace revisit::server {
namespace {

using std::chrono::milliseconds;

TEST(ShareOfTimeTest, BeginsAtOnce) {
  EXPECT_TRUE(ShareOfTime().MayBegin(milliseconds(0)));
}

TEST(ShareOfTimeTest, WorkThatTakesLongIsDoneSeldom) {
  ShareOfTime share;
  milliseconds now(1000);
  milliseconds worked(0);
  while (now < milliseconds(101'000)) {
    if (share.MayBegin(now)) {
      share.Ended(now, now + milliseconds(40));
      now += milliseconds(40);
      worked += milliseconds(40);
    }
    now += milliseconds(500);
  }
  EXPECT_GE(worked, milliseconds(800));
  EXPECT_LE(worked, milliseconds(1000));
}

TEST(ShareOfTimeTest, WorkThatTakesNextToNothingIsDoneWheneverItIsDue) {
  ShareOfTime share;
  for (milliseconds now(0); now < milliseconds(10'000);
       now += milliseconds(500)) {
    ASSERT_TRUE(share.MayBegin(now));
    share.Ended(now, now + milliseconds(4));
  }
}

}  // namespace
}  // namespace revisit::server
