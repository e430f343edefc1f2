#include "server/feed/sweep_pace.h"

#include <chrono>

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using std::chrono::microseconds;
using std::chrono::milliseconds;

TEST(SweepPaceTest, AFewThingsAreDoneInOneGo) {
  SweepPace pace(milliseconds(200), milliseconds(1000));
  for (int done = 1; done < 50; ++done) {
    EXPECT_EQ(pace.RestBefore(milliseconds(1000) + done * microseconds(10)),
              microseconds(0));
  }
}

TEST(SweepPaceTest, ManyThingsTakeAFifthOfTheTime) {
  SweepPace pace(milliseconds(200), milliseconds(0));
  microseconds now(0);
  microseconds rested(0);
  for (int i = 0; i < 1000; ++i) {
    now += microseconds(13);
    const auto rest =
        std::chrono::duration_cast<microseconds>(pace.RestBefore(now));
    // Nobody waits for longer than a burst.
    EXPECT_LE(rest, microseconds(4 * 513));
    now += rest;
    rested += rest;
  }
  EXPECT_NEAR(static_cast<double>(rested.count()), 4 * 13000, 4 * 513);
}

TEST(SweepPaceTest, WhoIsBehindItsTimeDoesNotRest) {
  SweepPace pace(milliseconds(200), milliseconds(0));
  // 1,000 things of 1 ms each take longer than the period in any case.
  microseconds now(0);
  microseconds rested(0);
  for (int i = 0; i < 1000; ++i) {
    now += milliseconds(1);
    const auto rest =
        std::chrono::duration_cast<microseconds>(pace.RestBefore(now));
    now += rest;
    rested += rest;
    EXPECT_LE(rested, milliseconds(160));
  }
  EXPECT_EQ(rested, milliseconds(160));
  EXPECT_EQ(pace.RestBefore(now + milliseconds(9)), microseconds(0));
}

TEST(SweepPaceTest, ARestIsNoWork) {
  SweepPace pace(milliseconds(200), milliseconds(0));
  EXPECT_EQ(pace.RestBefore(milliseconds(1)), milliseconds(4));
  EXPECT_EQ(pace.RestBefore(milliseconds(5) + microseconds(499)),
            microseconds(0));
  EXPECT_EQ(pace.RestBefore(milliseconds(6)), milliseconds(4));
}

}  // namespace
}  // namespace revisit::server
