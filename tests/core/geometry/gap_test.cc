#include "core/geometry/gap.h"

#include <cmath>
#include <limits>

#include "gtest/gtest.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr double kLimit = 50.0;

TEST(GapTest, ComparesAsItsLengthDoesAlsoWhereRoundingDecides) {
  auto random = SeededRandom();
  for (int i = 0; i < 100'000; ++i) {
    const double length =
        kLimit * (1.0 + UniformInt(random, -4, 4) *
                            std::numeric_limits<double>::epsilon());
    const double a = Uniform(random, -M_PI, M_PI);
    const double x = length * std::cos(a);
    const double y = length * std::sin(a);
    ASSERT_EQ(Gap(x, y).IsBelow(kLimit), std::hypot(x, y) < kLimit);
    ASSERT_EQ(Gap(x, y).IsAbove(kLimit), std::hypot(x, y) > kLimit);
  }
}

TEST(GapTest, ComparesLengthsThatAreFarFromTheLimit) {
  EXPECT_TRUE(Gap(30.0, -39.0).IsBelow(kLimit));
  EXPECT_FALSE(Gap(30.0, -39.0).IsAbove(kLimit));
  EXPECT_FALSE(Gap(-30.0, 41.0).IsBelow(kLimit));
  EXPECT_TRUE(Gap(-30.0, 41.0).IsAbove(kLimit));
  EXPECT_TRUE(Gap(1e200, 1e200).IsAbove(kLimit));
}

}  // namespace
}  // namespace revisit::core
