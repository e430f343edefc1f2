#include "server/base/periodic.h"

#include <atomic>
#include <chrono>
#include <thread>

#include "gtest/gtest.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

TEST(PeriodicTest, WorksAgainAndAgainUntilItGoes) {
  // It belongs to the thread of `periodic`, then to this one: no atomic, so
  // that the thread sanitizer sees a call that comes too late.
  int calls = 0;
  const Answer<bool> third;
  {
    const Periodic periodic(std::chrono::milliseconds(1), [&] {
      if (++calls == 3) third.Set(true);
    });
    third.Get();
  }
  EXPECT_GE(calls, 3);
}

TEST(PeriodicTest, GoesWithoutWaitingForItsTime) {
  int calls = 0;
  {
    const Periodic periodic(std::chrono::hours(1), [&] { ++calls; });
  }
  EXPECT_EQ(calls, 0);
}

TEST(PeriodicTest, WorksBeforeItsTimeIfItIsHastened) {
  const Answer<bool> worked;
  Periodic periodic(std::chrono::hours(1), [&] { worked.Set(true); });
  periodic.Hasten();
  // The test would be ended long before the hour is over.
  EXPECT_TRUE(worked.Get());
}

TEST(PeriodicTest, FinishesTheWorkItIsAtBeforeItGoes) {
  const Answer<bool> at_work;
  std::atomic<bool> finished{false};
  std::atomic<bool> leaving{false};
  {
    const Periodic periodic(std::chrono::milliseconds(1), [&] {
      if (at_work.IsSet()) return;
      at_work.Set(true);
      while (!leaving) std::this_thread::yield();
      finished = true;
    });
    at_work.Get();
    leaving = true;
  }
  EXPECT_TRUE(finished);
}

}  // namespace
}  // namespace revisit::server
