#include "server/sessions/fair_executor.h"

#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

// Longer than a task may go on without asking whether it is the turn of others.
constexpr std::chrono::milliseconds kLong{2};

// Works, and yields, until told to end.
void YieldUntil(const std::function<bool()>& end) {
  while (!end()) {
    std::this_thread::sleep_for(kLong);
    FairExecutor::Yield();
  }
}

TEST(FairExecutorTest, RunsEveryTaskOnce) {
  std::atomic<int> runs{0};
  {
    FairExecutor executor("test", 4);
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; ++t) {
      threads.emplace_back([&, t] {
        for (int i = 0; i < 1000; ++i) {
          executor.Post(std::to_string((t + i) % 5), [&] {
            ++runs;
            FairExecutor::Yield();
          });
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  EXPECT_EQ(runs, 4000);
}

TEST(FairExecutorTest, RunsTasksOfOneFlowAtTheSameTime) {
  FairExecutor executor("test", 2);
  const Answer<bool> first;
  const Answer<bool> second;
  const Answer<bool> both;
  executor.Post("a", [=] {
    first.Set(true);
    both.Set(second.Get());
  });
  executor.Post("a", [=] {
    second.Set(true);
    first.Get();
  });
  EXPECT_TRUE(both.Get());
}

TEST(FairExecutorTest, DestructorRunsWhatTasksPost) {
  std::atomic<int> runs{0};
  std::function<void(FairExecutor*, int)> post;
  post = [&](FairExecutor* executor, int left) {
    executor->Post(std::to_string(left % 3), [&, executor, left] {
      ++runs;
      if (left > 0) post(executor, left - 1);
    });
  };
  {
    FairExecutor executor("test", 2);
    post(&executor, 100);
  }
  EXPECT_EQ(runs, 101);
}

TEST(FairExecutorTest, DropsWhatTasksHold) {
  FairExecutor executor("test", 1);
  auto held = std::make_shared<int>(1);
  const std::weak_ptr<int> watch = held;
  executor.Post("a", [held = std::move(held)] {});
  const Answer<bool> later;
  executor.Post("a", [=] { later.Set(watch.expired()); });
  EXPECT_TRUE(later.Get());
}

TEST(FairExecutorTest, TaskThatTakesLongLetsAnotherFlowGoFirst) {
  FairExecutor executor("test", 1);
  const Answer<bool> other;
  const Answer<bool> ended;
  executor.Post("long", [&] {
    executor.Post("other", [=] { other.Set(true); });
    YieldUntil([&] { return other.IsSet(); });
    ended.Set(true);
  });
  EXPECT_TRUE(ended.Get());
}

TEST(FairExecutorTest, TaskGoesOnBeforeOthersOfItsFlow) {
  FairExecutor executor("test", 1);
  const Answer<bool> other;
  const Answer<bool> behind;
  const Answer<bool> was_first;
  executor.Post("long", [&] {
    executor.Post("long", [=] { behind.Set(true); });
    for (int i = 0; i < 5; ++i) {
      std::this_thread::sleep_for(kLong);
      FairExecutor::Yield();
    }
    executor.Post("other", [=] { other.Set(true); });
    YieldUntil([&] { return other.IsSet(); });
    was_first.Set(!behind.IsSet());
  });
  EXPECT_TRUE(was_first.Get());
  EXPECT_TRUE(behind.Get());
}

TEST(FairExecutorTest, FlowsOfLongTasksLeaveAnotherItsTurns) {
  std::atomic<bool> enough{false};
  std::atomic<int> long_tasks{0};
  {
    FairExecutor executor("test", 2);
    for (int i = 0; i < 24; ++i) {
      executor.Post("long " + std::to_string(i % 8), [&] {
        ++long_tasks;
        YieldUntil([&] { return enough.load(); });
      });
    }
    for (int i = 0; i < 30; ++i) {
      const Answer<bool> ran;
      executor.Post("short", [=] { ran.Set(true); });
      EXPECT_TRUE(ran.Get());
    }
    enough = true;
  }
  EXPECT_EQ(long_tasks, 24);
}

TEST(FairExecutorTest, YieldSaysHowLongOthersHadTheirTurn) {
  FairExecutor executor("test", 1);
  EXPECT_EQ(FairExecutor::Yield(), FairExecutor::Clock::duration::zero());
  constexpr std::chrono::milliseconds kOther{30};
  const Answer<FairExecutor::Clock::duration> answer;
  executor.Post("long", [&] {
    executor.Post("other", [=] { std::this_thread::sleep_for(kOther); });
    FairExecutor::Clock::duration waited{};
    while (waited == FairExecutor::Clock::duration::zero()) {
      std::this_thread::sleep_for(kLong);
      waited = FairExecutor::Yield();
    }
    answer.Set(waited);
  });
  EXPECT_GE(answer.Get(), kOther);
}

TEST(FairExecutorTest, NoMoreTasksRunThanMayAtATime) {
  std::mt19937_64 random = SeededRandom();
  constexpr int kAtATime = 3;
  std::atomic<int> running{0};
  std::atomic<int> most{0};
  std::atomic<int> runs{0};
  {
    FairExecutor executor("test", kAtATime);
    for (int i = 0; i < 300; ++i) {
      const std::string flow = std::to_string(UniformInt(random, 0, 20));
      const int yields = UniformInt(random, 0, 3);
      executor.Post(flow, [&, yields] {
        const auto enter = [&] {
          const int now = ++running;
          int before = most;
          while (before < now && !most.compare_exchange_weak(before, now)) {
          }
        };
        enter();
        for (int k = 0; k < yields; ++k) {
          std::this_thread::sleep_for(kLong);
          // It does not run while others have their turn.
          --running;
          FairExecutor::Yield();
          enter();
        }
        --running;
        ++runs;
      });
    }
  }
  EXPECT_EQ(runs, 300);
  EXPECT_LE(most, kAtATime);
}

// Beyond what may stop, tasks run to their ends.
TEST(FairExecutorTest, ManyFlowsOfLongTasksAllComeToTheirEnd) {
  std::atomic<int> runs{0};
  {
    FairExecutor executor("test", 1);
    for (int i = 0; i < 80; ++i) {
      executor.Post(std::to_string(i), [&] {
        for (int k = 0; k < 3; ++k) {
          std::this_thread::sleep_for(kLong);
          FairExecutor::Yield();
        }
        ++runs;
      });
    }
  }
  EXPECT_EQ(runs, 80);
}

}  // namespace
}  // namespace revisit::server
