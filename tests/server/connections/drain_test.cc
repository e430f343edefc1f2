#include "server/connections/drain.h"

#include <chrono>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using std::chrono::steady_clock;

TEST(DrainTest, TellsEveryWatcherOnceAndThoseThatComeLateAtOnce) {
  Drain drain;
  std::vector<int> told;
  drain.Watch([&] { told.push_back(1); });
  const Drain::WatchId gone = drain.Watch([&] { told.push_back(2); });
  drain.Watch([&] { told.push_back(3); });
  drain.Unwatch(gone);
  EXPECT_THAT(told, ::testing::IsEmpty());
  drain.Start();
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3));
  drain.Watch([&] { told.push_back(4); });
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3, 4));
  drain.Start();
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3, 4));
}

TEST(DrainTest, WatcherMayUnwatchWhileItIsTold) {
  Drain drain;
  Drain::WatchId id = -1;
  id = drain.Watch([&] { drain.Unwatch(id); });
  drain.Start();
  drain.Watch([&] { drain.Unwatch(id); });
}

TEST(DrainTest, RefusesCallsOnceStarted) {
  Drain drain;
  EXPECT_TRUE(drain.Enter());
  drain.Start();
  EXPECT_FALSE(drain.Enter());
  EXPECT_THAT(Drain::Refusal(),
              IsError(absl::StatusCode::kUnavailable, "SERVER_DRAINING",
                      "the server is shutting down; reconnect"));
}

TEST(DrainTest, KnowsWhetherACallerMayHaveToReadHowACallEnded) {
  Drain idle;
  EXPECT_TRUE(idle.Enter());
  idle.Leave();
  idle.Start();
  EXPECT_FALSE(idle.HasEndedCalls());
  EXPECT_FALSE(idle.Enter());
  EXPECT_TRUE(idle.HasEndedCalls());

  Drain busy;
  EXPECT_TRUE(busy.Enter());
  EXPECT_FALSE(busy.HasEndedCalls());
  busy.Start();
  busy.Leave();
  busy.Start();
  EXPECT_TRUE(busy.HasEndedCalls());
}

TEST(DrainTest, WaitsForTheLastCall) {
  Drain drain;
  drain.Enter();
  drain.Start();
  drain.Enter();
  std::thread calls([&] {
    drain.Leave();
    drain.Leave();
  });
  // Far off: the calls end it.
  drain.WaitForCalls(steady_clock::now() + std::chrono::hours(1));
  calls.join();
  drain.WaitForCalls(steady_clock::now() + std::chrono::hours(1));
}

TEST(DrainTest, WaitsNoLongerThanTheDeadline) {
  Drain drain;
  drain.Enter();
  drain.Start();
  const auto deadline = steady_clock::now() + std::chrono::milliseconds(20);
  drain.WaitForCalls(deadline);
  EXPECT_GE(steady_clock::now(), deadline);
}

}  // namespace
}  // namespace revisit::server
