#include "server/connections/drain.h"

#include <atomic>
#include <chrono>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using std::chrono::steady_clock;
using ::testing::_;

const auto kDraining =
    IsError(absl::StatusCode::kUnavailable, "SERVER_DRAINING",
            "the server is shutting down; reconnect");

TEST(DrainTest, TellsEveryWatcherOnceAndThoseThatComeLateAtOnce) {
  Drain drain;
  std::vector<int> told;
  const auto note = [&told](int number) {
    return [&told, number](const Drain::End& end) {
      EXPECT_THAT(end.status, kDraining);
      EXPECT_FALSE(end.at_once);
      told.push_back(number);
    };
  };
  drain.Watch(note(1));
  const Drain::WatchId gone = drain.Watch(note(2));
  drain.Watch(note(3));
  drain.Unwatch(gone);
  EXPECT_THAT(told, ::testing::IsEmpty());
  drain.Start();
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3));
  drain.Watch(note(4));
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3, 4));
  drain.Start();
  EXPECT_THAT(told, ::testing::ElementsAre(1, 3, 4));
}

TEST(DrainTest, WatcherMayUnwatchWhileItIsTold) {
  Drain drain;
  Drain::WatchId id = -1;
  int told = 0;
  const auto unwatch = [&](const Drain::End&) {
    drain.Unwatch(id);
    ++told;
  };
  id = drain.Watch(unwatch);
  drain.Start();
  EXPECT_EQ(told, 1);
  drain.Watch(unwatch);
  EXPECT_EQ(told, 2);
}

TEST(DrainTest, RefusesCallsOnceStarted) {
  Drain drain;
  EXPECT_THAT(drain.Enter(true), IsOk());
  drain.Start();
  EXPECT_THAT(drain.Enter(true), kDraining);
  EXPECT_THAT(drain.Enter(false), kDraining);
}

TEST(DrainTest,
     EndsCallsWheneverTheStoreIsSuspendedAndRefusesOthersUntilItIsNot) {
  const auto kStale = IsError(absl::StatusCode::kUnavailable, "LEASE_STALE", _);
  const absl::Status stale =
      Error(absl::StatusCode::kUnavailable, "LEASE_STALE", "cut off");
  Drain drain;
  int told = 0;
  const auto note = [&](const Drain::End& end) {
    EXPECT_THAT(end.status, kStale);
    EXPECT_TRUE(end.at_once);
    ++told;
  };
  const Drain::WatchId early = drain.Watch(note);
  drain.Suspend(stale);
  EXPECT_EQ(told, 1);
  EXPECT_THAT(drain.Enter(/*needs_store=*/true), kStale);
  EXPECT_THAT(drain.Enter(/*needs_store=*/false), IsOk());
  // One that came between its entry and the suspension.
  const Drain::WatchId late = drain.Watch(note);
  EXPECT_EQ(told, 2);
  drain.Resume();
  EXPECT_THAT(drain.Enter(/*needs_store=*/true), IsOk());
  drain.Unwatch(early);
  drain.Suspend(stale);
  EXPECT_EQ(told, 3);
  drain.Unwatch(late);
  drain.Start();
  EXPECT_THAT(drain.Enter(/*needs_store=*/true), kDraining);
  EXPECT_EQ(told, 3);
}

TEST(DrainTest, KnowsWhetherACallerMayHaveToReadHowACallEnded) {
  Drain idle;
  EXPECT_THAT(idle.Enter(true), IsOk());
  idle.Leave();
  idle.Start();
  EXPECT_FALSE(idle.HasEndedCalls());
  EXPECT_THAT(idle.Enter(true), kDraining);
  EXPECT_TRUE(idle.HasEndedCalls());

  Drain busy;
  EXPECT_THAT(busy.Enter(true), IsOk());
  EXPECT_FALSE(busy.HasEndedCalls());
  busy.Start();
  busy.Leave();
  busy.Start();
  EXPECT_TRUE(busy.HasEndedCalls());
}

TEST(DrainTest, WaitsForTheLastCall) {
  Drain drain;
  static_cast<void>(drain.Enter(true));
  drain.Start();
  static_cast<void>(drain.Enter(true));
  std::atomic<int> leaving{0};
  std::thread calls([&] {
    ++leaving;
    drain.Leave();
    ++leaving;
    drain.Leave();
  });
  // Far off: the calls end it.
  const auto deadline = steady_clock::now() + std::chrono::hours(1);
  drain.WaitForCalls(deadline);
  EXPECT_EQ(leaving, 2);
  calls.join();
  drain.WaitForCalls(deadline);
  EXPECT_LT(steady_clock::now(), deadline);
}

TEST(DrainTest, WaitsNoLongerThanTheDeadline) {
  Drain drain;
  static_cast<void>(drain.Enter(true));
  drain.Start();
  const auto deadline = steady_clock::now() + std::chrono::milliseconds(20);
  drain.WaitForCalls(deadline);
  EXPECT_GE(steady_clock::now(), deadline);
}

}  // namespace
}  // namespace revisit::server
