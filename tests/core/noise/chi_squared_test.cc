#include "core/noise/chi_squared.h"

#include <gtest/gtest.h>

#include <boost/math/distributions/chi_squared.hpp>
#include <cmath>
#include <limits>

namespace revisit::core {
namespace {

TEST(ChiSquaredTest, AgreesWithTheTables) {
  // Abramowitz & Stegun, table 26.8.
  EXPECT_NEAR(ChiSquaredQuantile(1.0, 0.95), 3.84146, 5e-6);
  EXPECT_NEAR(ChiSquaredQuantile(10.0, 0.99), 23.2093, 5e-5);
  // With two degrees of freedom, 1 - exp(-x / 2).
  EXPECT_NEAR(ChiSquaredBelow(2.0, 3.0), 1.0 - std::exp(-1.5), 1e-14);
  EXPECT_NEAR(ChiSquaredAbove(2.0, 3.0), std::exp(-1.5), 1e-14);
}

TEST(ChiSquaredTest, DegreesOfFreedomNeedNotBeWhole) {
  for (const double degrees : {0.3, 2.5, 47.4, 3003.0}) {
    for (const double probability : {1e-6, 0.5, 0.95, 0.999999}) {
      const double x = ChiSquaredQuantile(degrees, probability);
      EXPECT_NEAR(ChiSquaredBelow(degrees, x), probability, 1e-9);
      EXPECT_NEAR(ChiSquaredAbove(degrees, x), 1.0 - probability, 1e-9);
    }
  }
}

TEST(ChiSquaredTest, AgreesWithMorePrecision) {
  using Precise = boost::math::chi_squared_distribution<long double>;
  for (double degrees = 0.7; degrees < 500.0; degrees *= 1.3) {
    const Precise precise(degrees);
    for (const double x : {0.01, 0.3, 0.8, 1.0, 1.2, 2.0, 3.0}) {
      const auto below =
          static_cast<double>(boost::math::cdf(precise, x * degrees));
      const auto above = static_cast<double>(
          boost::math::cdf(boost::math::complement(precise, x * degrees)));
      EXPECT_NEAR(ChiSquaredBelow(degrees, x * degrees), below, 1e-13 * below);
      EXPECT_NEAR(ChiSquaredAbove(degrees, x * degrees), above, 1e-12 * above);
    }
    for (const double probability : {0.01, 0.5, 0.95, 0.99, 0.999}) {
      const auto threshold =
          static_cast<double>(boost::math::quantile(precise, probability));
      EXPECT_NEAR(ChiSquaredQuantile(degrees, probability), threshold,
                  1e-13 * threshold);
    }
  }
}

TEST(ChiSquaredTest, ExtremeArgumentsGiveNumbersAndNotExceptions) {
  const double infinity = std::numeric_limits<double>::infinity();
  const double nan = std::nan("");
  EXPECT_EQ(ChiSquaredAbove(3.0, 1e300), 0.0);
  EXPECT_EQ(ChiSquaredBelow(3.0, 1e300), 1.0);
  EXPECT_EQ(ChiSquaredBelow(3.0, 0.0), 0.0);
  for (const double odd : {-1.0, 0.0, 1e300, infinity, nan}) {
    ChiSquaredQuantile(odd, 0.95);
    ChiSquaredQuantile(3.0, odd);
    ChiSquaredBelow(odd, 1.0);
    ChiSquaredBelow(3.0, odd);
    ChiSquaredAbove(odd, 1.0);
    ChiSquaredAbove(3.0, odd);
  }
}

}  // namespace
}  // namespace revisit::core
