#include "server/connections/held_calls.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <random>
#include <vector>

#include "gtest/gtest.h"
#include "tests/random.h"

namespace revisit::server {
namespace {

// What one call is estimated to take, and one byte of its headers.
constexpr std::uint64_t kCall = 24 << 10;
constexpr std::uint64_t kHeaderByte = 160;

void Add(std::uint64_t bytes, HeldCalls* calls) {
  calls->Begin(bytes);
  calls->Complete();
}

TEST(HeldCallsTest, EstimatesCallsAndTheirHeaders) {
  HeldCalls calls;
  EXPECT_EQ(calls.memory(), 0u);
  calls.Begin(100);
  calls.Grow(50);
  calls.Begin(0);
  EXPECT_EQ(calls.count(), 2u);
  EXPECT_EQ(calls.memory(), 2 * kCall + 150 * kHeaderByte);
}

TEST(HeldCallsTest, TakesTheSmallestToBeOverFirst) {
  HeldCalls calls;
  Add(100000, &calls);
  for (int i = 0; i < 1000; ++i) Add(10, &calls);
  calls.End(1000);
  EXPECT_EQ(calls.count(), 1u);
  EXPECT_EQ(calls.memory(), kCall + 100000 * kHeaderByte);
  calls.End(1);
  EXPECT_EQ(calls.memory(), 0u);
}

TEST(HeldCallsTest, CallWhoseHeadersGoOnIsNotOver) {
  HeldCalls calls;
  Add(10, &calls);
  calls.Begin(5);
  calls.End(2);
  for (int i = 0; i < 100; ++i) calls.Grow(1000);
  EXPECT_EQ(calls.memory(), kCall + 100005 * kHeaderByte);
  calls.Complete();
  EXPECT_EQ(calls.memory(), kCall + 100005 * kHeaderByte);
  calls.End(1);
  EXPECT_EQ(calls.memory(), 0u);
}

TEST(HeldCallsTest, MoreEndsThanCallsAreNone) {
  HeldCalls calls;
  Add(10, &calls);
  calls.End(5);
  EXPECT_EQ(calls.count(), 0u);
  EXPECT_EQ(calls.memory(), 0u);
  // Headers that go on without having begun.
  calls.Grow(1000);
  calls.Complete();
  EXPECT_EQ(calls.memory(), 0u);
}

// Calls of one size class are taken to be alike, so that the estimate of their
// headers is off by a factor of two at most.
TEST(HeldCallsTest, AgreesWithAListOfAllCalls) {
  std::mt19937_64 random = SeededRandom();
  HeldCalls calls;
  std::vector<std::uint64_t> all;
  for (int i = 0; i < 2000; ++i) {
    if (random() % 3 == 0 && !all.empty()) {
      const std::size_t over = 1 + random() % all.size();
      std::sort(all.begin(), all.end());
      all.erase(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(over));
      calls.End(over);
    } else {
      all.push_back(random() % 5000);
      calls.Begin(all.back());
      if (random() % 2 == 0) {
        calls.Grow(700);
        all.back() += 700;
      }
      calls.Complete();
    }
    std::uint64_t bytes = 0;
    for (const std::uint64_t one : all) bytes += one;
    ASSERT_EQ(calls.count(), all.size());
    ASSERT_GE(calls.memory(), all.size() * kCall + bytes / 2 * kHeaderByte);
    ASSERT_LE(calls.memory(), all.size() * kCall + bytes * 2 * kHeaderByte);
  }
}

}  // namespace
}  // namespace revisit::server
