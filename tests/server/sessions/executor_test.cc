#include "server/sessions/executor.h"

#include <algorithm>
#include <atomic>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

TEST(ExecutorTest, RunsEveryTaskOnce) {
  std::atomic<int> runs{0};
  {
    Executor executor(4);
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; ++t) {
      threads.emplace_back([&] {
        for (int i = 0; i < 1000; ++i) executor.Post([&] { ++runs; });
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  EXPECT_EQ(runs, 4000);
}

TEST(ExecutorTest, RunsTasksAtTheSameTime) {
  Executor executor(2);
  const Answer<bool> first;
  const Answer<bool> second;
  const Answer<bool> both;
  executor.Post([=] {
    first.Set(true);
    both.Set(second.Get());
  });
  executor.Post([=] {
    second.Set(true);
    first.Get();
  });
  EXPECT_TRUE(both.Get());
}

TEST(ExecutorTest, DestructorRunsWhatTasksPost) {
  std::atomic<int> runs{0};
  std::function<void(Executor*, int)> post;
  post = [&](Executor* executor, int left) {
    executor->Post([&, executor, left] {
      ++runs;
      if (left > 0) post(executor, left - 1);
    });
  };
  {
    Executor executor(2);
    post(&executor, 100);
  }
  EXPECT_EQ(runs, 101);
}

TEST(ExecutorTest, DropsWhatTasksHold) {
  Executor executor(1);
  auto held = std::make_shared<int>(1);
  const std::weak_ptr<int> watch = held;
  executor.Post([held = std::move(held)] {});
  const Answer<bool> later;
  executor.Post([=] { later.Set(watch.expired()); });
  EXPECT_TRUE(later.Get());
}

TEST(StrandTest, RunsTasksInOrderAndNeverTwoAtOnce) {
  constexpr int kTasks = 2000;
  std::vector<int> order;  // Not guarded: that is the point.
  std::atomic<int> running{0};
  {
    Executor executor(4);
    const std::shared_ptr<Strand> strand = Strand::Create(&executor);
    for (int i = 0; i < kTasks; ++i) {
      strand->Post([&, i] {
        EXPECT_EQ(++running, 1);
        order.push_back(i);
        --running;
      });
    }
  }
  ASSERT_EQ(order.size(), static_cast<std::size_t>(kTasks));
  EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
}

TEST(StrandTest, KeepsOrderOfEachOfManyPosters) {
  constexpr int kThreads = 4;
  constexpr int kTasks = 500;
  std::vector<std::vector<int>> order(kThreads);
  {
    Executor executor(3);
    const std::shared_ptr<Strand> strand = Strand::Create(&executor);
    std::vector<std::thread> threads;
    for (std::size_t t = 0; t < kThreads; ++t) {
      threads.emplace_back([&, t] {
        for (int i = 0; i < kTasks; ++i) {
          strand->Post([&order, t, i] { order[t].push_back(i); });
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  for (const std::vector<int>& posted : order) {
    EXPECT_EQ(posted.size(), static_cast<std::size_t>(kTasks));
    EXPECT_TRUE(std::is_sorted(posted.begin(), posted.end()));
  }
}

TEST(StrandTest, GivesOtherStrandsTheirTurn) {
  // One thread, and a strand that always has more to do until the other ran.
  Executor executor(1);
  const std::shared_ptr<Strand> busy = Strand::Create(&executor);
  const std::shared_ptr<Strand> other = Strand::Create(&executor);
  std::atomic<bool> other_ran{false};
  const Answer<bool> ended;
  std::function<void()> again = [&] {
    if (other_ran) {
      ended.Set(true);
    } else {
      busy->Post(again);
    }
  };
  busy->Post(again);
  other->Post([&] { other_ran = true; });
  EXPECT_TRUE(ended.Get());
}

TEST(StrandTest, RunsTasksAtOnceWhereNothingStandsInTheWay) {
  Executor executor(1);
  const std::shared_ptr<Strand> strand = Strand::Create(&executor);
  const std::thread::id here = std::this_thread::get_id();
  std::thread::id ran_on;
  strand->RunOrPost([&] { ran_on = std::this_thread::get_id(); });
  EXPECT_EQ(ran_on, here);
}

TEST(StrandTest, KeepsOrderOfTasksThatMayRunAtOnce) {
  constexpr int kThreads = 4;
  constexpr int kTasks = 2000;
  std::vector<std::vector<int>> order(kThreads);
  std::atomic<int> running{0};
  {
    Executor executor(2);
    const std::shared_ptr<Strand> strand = Strand::Create(&executor);
    std::vector<std::thread> threads;
    for (std::size_t t = 0; t < kThreads; ++t) {
      threads.emplace_back([&, t] {
        for (int i = 0; i < kTasks; ++i) {
          const auto task = [&, t, i] {
            EXPECT_EQ(++running, 1);
            order[t].push_back(i);
            --running;
          };
          if (i % 3 == 0) {
            strand->Post(task);
          } else {
            strand->RunOrPost(task);
          }
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  for (const std::vector<int>& posted : order) {
    EXPECT_EQ(posted.size(), static_cast<std::size_t>(kTasks));
    EXPECT_TRUE(std::is_sorted(posted.begin(), posted.end()));
  }
}

TEST(StrandTest, RunsEachTaskInItsLaneAndAllInOrder) {
  constexpr int kTasks = 1000;
  std::vector<int> order;
  {
    Executor short_work(2);
    Executor long_work(2);
    // Known by the thread: tasks of a lane run on its threads only.
    std::mutex mutex;
    std::map<std::thread::id, bool> is_long;
    const std::shared_ptr<Strand> strand =
        Strand::Create(Lanes(&short_work, &long_work));
    for (int i = 0; i < kTasks; ++i) {
      const bool long_task = i % 5 < 2;
      const auto task = [&, i, long_task] {
        order.push_back(i);
        const std::lock_guard<std::mutex> guard(mutex);
        const auto [known, fresh] =
            is_long.emplace(std::this_thread::get_id(), long_task);
        EXPECT_EQ(known->second, long_task);
      };
      if (long_task) {
        strand->PostLong(task);
      } else {
        strand->Post(task);
      }
    }
    const Answer<bool> all;
    strand->Post([all] { all.Set(true); });
    all.Get();
  }
  ASSERT_EQ(order.size(), static_cast<std::size_t>(kTasks));
  EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
}

TEST(StrandTest, LongWorkHoldsUpItsOwnStrandOnly) {
  Executor short_work(1);
  Executor long_work(1);
  const Lanes lanes(&short_work, &long_work);
  const std::shared_ptr<Strand> busy = Strand::Create(lanes);
  const std::shared_ptr<Strand> other = Strand::Create(lanes);
  const Answer<bool> started;
  const Answer<bool> gate;
  const Answer<bool> behind;
  busy->PostLong([=] {
    started.Set(true);
    gate.Get();
  });
  busy->Post([=] { behind.Set(true); });
  started.Get();
  for (int i = 0; i < 100; ++i) {
    const Answer<bool> ran;
    other->Post([=] { ran.Set(true); });
    EXPECT_TRUE(ran.Get());
  }
  EXPECT_FALSE(behind.IsSet());
  gate.Set(true);
  EXPECT_TRUE(behind.Get());
}

TEST(StrandTest, ShortWorkDoesNotWaitForASearchThatWaitsForOthers) {
  Executor short_work(1);
  Executor searches(1);
  const Lanes lanes(&short_work, &short_work, &searches);
  const std::shared_ptr<Strand> strand = Strand::Create(lanes);
  const Answer<bool> gate;
  const Answer<bool> searched;
  searches.Post([=] { gate.Get(); });
  strand->PostSearch("mine", [=] { searched.Set(true); });
  for (int i = 0; i < 100; ++i) {
    const Answer<bool> ran;
    strand->Post([=] { ran.Set(true); });
    EXPECT_TRUE(ran.Get());
  }
  EXPECT_FALSE(strand->IsWanted());
  EXPECT_FALSE(searched.IsSet());
  gate.Set(true);
  EXPECT_TRUE(searched.Get());
}

TEST(StrandTest, ASearchRunsInTheEndHoweverBusyItsStrandIs) {
  Executor short_work(1);
  Executor searches(1);
  const Lanes lanes(&short_work, &short_work, &searches);
  const std::shared_ptr<Strand> strand = Strand::Create(lanes);
  std::atomic<int> running{0};
  std::atomic<bool> searched{false};
  const Answer<bool> ended;
  // There is always more to do until the search ran.
  std::function<void()> again = [&] {
    EXPECT_EQ(++running, 1);
    const bool is_over = searched;
    --running;
    if (is_over) {
      ended.Set(true);
    } else {
      strand->Post(again);
    }
  };
  strand->Post(again);
  strand->PostSearch("mine", [&] {
    EXPECT_EQ(++running, 1);
    searched = true;
    --running;
  });
  EXPECT_TRUE(ended.Get());
}

TEST(StrandTest, TaskMayDropTheLastReference) {
  Executor executor(2);
  for (int i = 0; i < 200; ++i) {
    std::shared_ptr<Strand> strand = Strand::Create(&executor);
    Strand* const raw = strand.get();
    const Answer<bool> ran;
    raw->Post([strand = std::move(strand), ran]() mutable {
      strand->Post([ran] { ran.Set(true); });
      strand.reset();
    });
    EXPECT_TRUE(ran.Get());
  }
}

}  // namespace
}  // namespace revisit::server
