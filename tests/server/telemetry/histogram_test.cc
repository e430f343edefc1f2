#include "server/base/histogram.h"

#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;

TEST(HistogramTest, PutsAValueIntoTheFirstBucketWhoseBoundIsNotBelowIt) {
  Histogram histogram({1.0, 2.0});
  for (const double value : {0.5, 1.0, 1.5, 2.0, 2.5, 100.0}) {
    histogram.Observe(value);
  }
  const HistogramCounts counts = histogram.Read();
  EXPECT_THAT(counts.bounds, ElementsAre(1.0, 2.0));
  EXPECT_THAT(counts.counts, ElementsAre(2, 2, 2));
  EXPECT_DOUBLE_EQ(counts.sum, 107.5);
}

TEST(HistogramTest, TakesTimesInSeconds) {
  Histogram histogram({1.0});
  histogram.Observe(std::chrono::milliseconds(250));
  EXPECT_DOUBLE_EQ(histogram.Read().sum, 0.25);
}

TEST(HistogramTest, LosesNothingThatSeveralThreadsObserve) {
  Histogram histogram({1.0});
  constexpr int kEach = 20'000;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      for (int j = 0; j < kEach; ++j) histogram.Observe(0.5);
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_THAT(histogram.Read().counts, ElementsAre(4 * kEach, 0));
  EXPECT_DOUBLE_EQ(histogram.Read().sum, 0.5 * 4 * kEach);
}

TEST(HistogramTest, CountsOfSeveralAreAdded) {
  Histogram one({1.0});
  Histogram other({1.0});
  one.Observe(0.5);
  other.Observe(3.0);
  HistogramCounts sum;
  sum.Add(one.Read());
  sum.Add(other.Read());
  EXPECT_THAT(sum.counts, ElementsAre(1, 1));
  EXPECT_DOUBLE_EQ(sum.sum, 3.5);
}

}  // namespace
}  // namespace revisit::server
