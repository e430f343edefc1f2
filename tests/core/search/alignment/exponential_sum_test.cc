#include "core/search/alignment/exponential_sum.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "core/search/belief/log_odds.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

TEST(ExponentialSumTest, LeavesOutWhatDoesNotChangeTheSum) {
  std::mt19937_64 random = SeededRandom();
  for (int k = 0; k < 2000; ++k) {
    const double spread = std::exp(Uniform(random, 0.0, 8.0));
    ExponentialSum sum;
    double all = 0.0;
    for (int i = 0; i < 24; ++i) {
      const double x = UniformInt(random, 0, 9) == 0
                           ? -std::numeric_limits<double>::infinity()
                           : Uniform(random, -spread, 0.0);
      sum.Add(x);
      all += std::exp(x);
      ASSERT_EQ(sum.value(), all) << x;
    }
  }
}

TEST(ExponentialSumTest, LogarithmsAddUpToTheLastBit) {
  std::mt19937_64 random = SeededRandom();
  for (int k = 0; k < 100000; ++k) {
    const double a =
        Uniform(random, -1.0, 1.0) * std::exp(Uniform(random, -40.0, 6.0));
    const double b = a - std::exp(Uniform(random, 0.0, 7.0));
    const double sum = a + std::log1p(std::exp(b - a));
    ASSERT_EQ(LogAdd(a, b), sum) << a << " " << b;
    ASSERT_EQ(LogAdd(b, a), sum) << a << " " << b;
  }
}

}  // namespace
}  // namespace revisit::core
