#include "server/sessions/fair_queue.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/oracle/plain_fair_queue.h"
#include "tests/random.h"

namespace revisit::server {
namespace {

using Queue = FairQueue<int>;

// Takes an item, charges its flow for it, and finishes it.
std::string Serve(Queue* queue, std::int64_t cost) {
  const std::optional<Queue::Taken> taken = queue->Take();
  if (!taken) return "";
  queue->Charge(taken->flow, cost);
  queue->Finish(taken->flow);
  return taken->flow + std::to_string(taken->item);
}

TEST(FairQueueTest, FlowsTakeTurnsHoweverMuchOneOfThemWants) {
  Queue queue(0);
  for (int i = 0; i < 5; ++i) queue.Push("a", i);
  queue.Push("b", 0);
  queue.Push("b", 1);
  std::vector<std::string> order;
  while (!queue.empty()) order.push_back(Serve(&queue, 1));
  EXPECT_THAT(order,
              testing::ElementsAre("a0", "b0", "a1", "b1", "a2", "a3", "a4"));
}

TEST(FairQueueTest, FlowWhoseItemsCostMoreGetsFewerTurns) {
  Queue queue(0);
  for (int i = 0; i < 3; ++i) queue.Push("dear", i);
  for (int i = 0; i < 6; ++i) queue.Push("cheap", i);
  std::vector<std::string> order;
  while (!queue.empty()) {
    const std::optional<Queue::Taken> taken = queue.Take();
    queue.Charge(taken->flow, taken->flow == "dear" ? 3 : 1);
    queue.Finish(taken->flow);
    order.push_back(taken->flow);
  }
  EXPECT_THAT(order,
              testing::ElementsAre("dear", "cheap", "cheap", "cheap", "dear",
                                   "cheap", "cheap", "cheap", "dear"));
}

TEST(FairQueueTest, FlowGetsNothingForTheTimeWhenItWantedNothing) {
  Queue queue(0);
  queue.Push("back", 0);
  for (int i = 0; i < 103; ++i) queue.Push("steady", i);
  for (int i = 0; i < 101; ++i) Serve(&queue, 10);
  for (int i = 0; i < 3; ++i) queue.Push("back", i);
  for (int i = 103; i < 105; ++i) queue.Push("steady", i);
  std::vector<std::string> order;
  while (!queue.empty()) order.push_back(Serve(&queue, 10));
  EXPECT_THAT(order, testing::ElementsAre("steady100", "back0", "steady101",
                                          "back1", "steady102", "back2",
                                          "steady103", "steady104"));
}

TEST(FairQueueTest, FlowThatComesBackHasItsCreditAtOnce) {
  Queue queue(25);
  for (int i = 0; i < 20; ++i) queue.Push("steady", i);
  for (int i = 0; i < 10; ++i) Serve(&queue, 10);
  for (int i = 0; i < 5; ++i) queue.Push("back", i);
  std::vector<std::string> order;
  for (int i = 0; i < 5; ++i) order.push_back(Serve(&queue, 10));
  EXPECT_THAT(order, testing::ElementsAre("back0", "back1", "back2", "steady10",
                                          "back3"));
}

TEST(FairQueueTest, ItemThatIsReturnedGoesOnBeforeOthersOfItsFlow) {
  Queue queue(0);
  for (int i = 0; i < 2; ++i) queue.Push("a", i);
  const Queue::Taken first = *queue.Take();
  queue.Push("b", 0);
  EXPECT_FALSE(queue.OthersFirst("a"));
  queue.Charge("a", 1);
  EXPECT_TRUE(queue.OthersFirst("a"));
  queue.Return("a", first.item);
  std::vector<std::string> order;
  while (!queue.empty()) order.push_back(Serve(&queue, 1));
  EXPECT_THAT(order, testing::ElementsAre("b0", "a0", "a1"));
}

TEST(FairQueueTest, ForgetsFlowsThatHaveNothingToDo) {
  Queue queue(5);
  for (int i = 0; i < 1000; ++i) {
    queue.Push("one of many " + std::to_string(i), i);
    Serve(&queue, 1);
    EXPECT_EQ(queue.flows(), 0u);
  }
  // While others have something to do, once these have used as much.
  for (int i = 0; i < 1000; ++i) {
    queue.Push("steady", i);
    queue.Push("one of many " + std::to_string(i), i);
    Serve(&queue, 10);
    Serve(&queue, 10);
    queue.Push("steady", i);
    EXPECT_LE(queue.flows(), 4u);
  }
  // However little those use that have something to do.
  queue.Push("at work", 0);
  while (queue.Take()->flow != "at work") continue;
  for (std::size_t i = 0; i < 2 * Queue::kMostIdle; ++i) {
    queue.Push("one of many " + std::to_string(i), 0);
    Serve(&queue, 1);
  }
  EXPECT_LE(queue.flows(), Queue::kMostIdle + 2);
}

TEST(FairQueueTest, IsThatOfTheOracle) {
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 300; ++round) {
    const std::int64_t credit = UniformInt(random, 0, 2) * 10;
    const int flow_count = UniformInt(random, 1, 6);
    Queue queue(credit);
    oracle::PlainFairQueue plain(credit);
    std::vector<std::pair<std::string, int>> at_work;
    std::vector<std::string> story;
    for (int move = 0; move < 300; ++move) {
      const int kind = UniformInt(random, 0, 9);
      if (kind < 3) {
        const std::string flow(
            1, static_cast<char>('a' + UniformInt(random, 0, flow_count - 1)));
        queue.Push(flow, move);
        plain.Push(flow, move);
        story.push_back("push " + flow);
      } else if (kind < 6) {
        const std::optional<Queue::Taken> taken = queue.Take();
        const auto expected = plain.Take();
        ASSERT_EQ(taken.has_value(), expected.has_value())
            << round << testing::PrintToString(story);
        if (!taken) continue;
        ASSERT_EQ(std::pair(taken->flow, taken->item), *expected)
            << round << testing::PrintToString(story);
        at_work.push_back(*expected);
        story.push_back("take " + taken->flow);
      } else if (!at_work.empty()) {
        const auto one =
            at_work.begin() +
            UniformInt(random, 0, static_cast<int>(at_work.size()) - 1);
        const auto [flow, item] = *one;
        const std::int64_t cost = UniformInt(random, 0, 20);
        queue.Charge(flow, cost);
        plain.Charge(flow, cost);
        story.push_back("charge " + flow + " " + std::to_string(cost));
        ASSERT_EQ(queue.OthersFirst(flow), plain.OthersFirst(flow))
            << round << testing::PrintToString(story);
        if (kind == 6) continue;
        at_work.erase(one);
        if (kind == 7) {
          queue.Return(flow, item);
          plain.Return(flow, item);
          story.push_back("return " + flow);
        } else {
          queue.Finish(flow);
          plain.Finish(flow);
          story.push_back("finish " + flow);
        }
      }
    }
  }
}

TEST(FairQueueTest, FlowsThatAlwaysWaitHaveUsedAboutAsMuchAtAnyTime) {
  std::mt19937_64 random = SeededRandom();
  constexpr std::int64_t kCredit = 30;
  constexpr int kMostCost = 50;
  for (int round = 0; round < 100; ++round) {
    Queue queue(kCredit);
    const int flow_count = UniformInt(random, 2, 8);
    const int at_a_time = UniformInt(random, 1, 4);
    std::map<std::string, std::int64_t> used;
    for (int f = 0; f < flow_count; ++f) {
      for (int i = 0; i < 2500; ++i) queue.Push(std::to_string(f), i);
      used[std::to_string(f)] = 0;
    }
    std::vector<std::string> at_work;
    for (int step = 0; step < 2000; ++step) {
      while (static_cast<int>(at_work.size()) < at_a_time) {
        at_work.push_back(queue.Take()->flow);
      }
      const auto one = at_work.begin() + UniformInt(random, 0, at_a_time - 1);
      const std::int64_t cost = UniformInt(random, 1, kMostCost);
      queue.Charge(*one, cost);
      queue.Finish(*one);
      used[*one] += cost;
      at_work.erase(one);
      const auto [least, most] = std::minmax_element(
          used.begin(), used.end(),
          [](const auto& a, const auto& b) { return a.second < b.second; });
      ASSERT_LE(most->second - least->second, kCredit + at_a_time * kMostCost)
          << "round " << round << ", step " << step;
    }
  }
}

}  // namespace
}  // namespace revisit::server
