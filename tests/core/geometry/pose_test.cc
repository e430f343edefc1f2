#include "core/geometry/pose.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::HasSubstr;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

PoseSample ValidSample() {
  PoseSample sample;
  sample.sequence = 1;
  for (int i = 0; i < 4; ++i) sample.covariance(i, i) = 1.0;
  return sample;
}

TEST(HeadingTest, WrapsIntoTheHalfOpenTurn) {
  EXPECT_DOUBLE_EQ(WrapHeading(0.0), 0.0);
  EXPECT_DOUBLE_EQ(WrapHeading(kPi), kPi);
  EXPECT_DOUBLE_EQ(WrapHeading(-kPi), kPi);
  EXPECT_DOUBLE_EQ(WrapHeading(3.0 * kPi), kPi);
  EXPECT_NEAR(WrapHeading(2.0 * kPi + 0.25), 0.25, 1e-15);
  EXPECT_NEAR(WrapHeading(-2.0 * kPi - 0.25), -0.25, 1e-15);
}

TEST(PoseTest, DifferenceTakesTheShorterArc) {
  const Pose d = Difference({1, 2, 3, 3.0}, {0, 0, 0, -3.0});
  EXPECT_DOUBLE_EQ(d.x, 1.0);
  EXPECT_DOUBLE_EQ(d.y, 2.0);
  EXPECT_DOUBLE_EQ(d.z, 3.0);
  EXPECT_NEAR(d.heading, 6.0 - 2.0 * kPi, 1e-15);
}

TEST(PoseTest, PlanarDistanceIgnoresHeight) {
  EXPECT_DOUBLE_EQ(Distance({3, 4, 12, 0}, {}, StateSpace::kPlanar), 5.0);
  EXPECT_DOUBLE_EQ(Distance({3, 4, 12, 0}, {}, StateSpace::kSpatial), 13.0);
}

TEST(CovarianceTest, PacksTheUpperTriangleByRows) {
  Covariance covariance;
  for (std::size_t i = 0; i < 10; ++i) {
    covariance.upper[i] = static_cast<double>(i);
  }
  const double expected[4][4] = {
      {0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
  for (int r = 0; r < 4; ++r) {
    for (int c = 0; c < 4; ++c) {
      EXPECT_EQ(covariance(r, c), expected[r][c]) << r << "," << c;
    }
  }
  EXPECT_EQ(ToMatrix<3>(covariance)(0, 2), 3.0);
  EXPECT_EQ(ToMatrix<3>(covariance)(2, 2), 9.0);
}

TEST(CovarianceTest, SurvivesTheWayToAMatrixAndBack) {
  std::mt19937_64 random = SeededRandom();
  const Covariance covariance = RandomCovariance(random, 3.0);
  EXPECT_EQ(ToCovariance<4>(ToMatrix<4>(covariance)).upper, covariance.upper);
}

TEST(FindDefectTest, AcceptsWhatIsValidInBothStateSpaces) {
  EXPECT_FALSE(FindDefect(ValidSample(), StateSpace::kPlanar));
  EXPECT_FALSE(FindDefect(ValidSample(), StateSpace::kSpatial));
}

TEST(FindDefectTest, AcceptsNegativeZeroAndDenormals) {
  PoseSample sample = ValidSample();
  sample.pose.x = -0.0;
  sample.pose.y = std::numeric_limits<double>::denorm_min();
  EXPECT_FALSE(FindDefect(sample, StateSpace::kPlanar));
}

TEST(FindDefectTest, NamesWhatIsNotFinite) {
  for (double bad : {kNan, kInfinity, -kInfinity}) {
    PoseSample sample = ValidSample();
    sample.pose.y = bad;
    auto defect = FindDefect(sample, StateSpace::kPlanar);
    ASSERT_TRUE(defect);
    EXPECT_EQ(defect->kind, DefectKind::kNotFinite);
    EXPECT_EQ(defect->part, "position");
    EXPECT_EQ(defect->description, "y is not a finite number");

    sample = ValidSample();
    sample.pose.heading = bad;
    defect = FindDefect(sample, StateSpace::kPlanar);
    ASSERT_TRUE(defect);
    EXPECT_EQ(defect->kind, DefectKind::kNotFinite);
    EXPECT_EQ(defect->part, "heading");

    sample = ValidSample();
    sample.covariance(0, 3) = bad;
    defect = FindDefect(sample, StateSpace::kPlanar);
    ASSERT_TRUE(defect);
    EXPECT_EQ(defect->kind, DefectKind::kNotFinite);
    EXPECT_EQ(defect->part, "covariance");
    EXPECT_THAT(defect->description, HasSubstr("x and heading"));

    sample = ValidSample();
    sample.transition.emplace();
    sample.transition->values[3] = bad;
    defect = FindDefect(sample, StateSpace::kPlanar);
    ASSERT_TRUE(defect);
    EXPECT_EQ(defect->kind, DefectKind::kNotFinite);
    EXPECT_EQ(defect->part, "error_transition");
  }
}

TEST(FindDefectTest, SaysWhatWasGotAndWhatIsAllowed) {
  PoseSample sample = ValidSample();
  sample.pose.x = -2e8;
  auto defect = FindDefect(sample, StateSpace::kPlanar);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kOutOfRange);
  EXPECT_EQ(defect->description,
            "x is -200000000; allowed is [-100000000, 100000000]");

  sample = ValidSample();
  sample.pose.heading = 1.5e6;
  defect = FindDefect(sample, StateSpace::kPlanar);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->description,
            "heading is 1500000; allowed is [-1000000, 1000000]");

  sample = ValidSample();
  sample.covariance(1, 1) = 4e18;
  defect = FindDefect(sample, StateSpace::kPlanar);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kOutOfRange);
  EXPECT_EQ(defect->description,
            "the standard deviation of y is 2e+09; allowed is at most 1e+09");
}

TEST(FindDefectTest, RefusesWhatIsNotPositiveDefinite) {
  PoseSample zero_variance = ValidSample();
  zero_variance.covariance(3, 3) = 0.0;
  auto defect = FindDefect(zero_variance, StateSpace::kPlanar);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kNotPositiveDefinite);
  EXPECT_THAT(defect->description, HasSubstr("variance of heading is 0"));

  PoseSample singular = ValidSample();  // x and y wholly correlated.
  singular.covariance(0, 1) = 1.0;
  defect = FindDefect(singular, StateSpace::kSpatial);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kNotPositiveDefinite);

  PoseSample indefinite = ValidSample();
  indefinite.covariance(0, 3) = 1.5;
  defect = FindDefect(indefinite, StateSpace::kPlanar);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kNotPositiveDefinite);
}

TEST(FindDefectTest, PositiveDefinitenessDoesNotDependOnUnits) {
  PoseSample sample = ValidSample();
  sample.covariance(0, 0) = 1e16;   // A hundred thousand kilometres.
  sample.covariance(3, 3) = 1e-16;  // A nanodegree.
  EXPECT_FALSE(FindDefect(sample, StateSpace::kPlanar));
}

TEST(FindDefectTest, PlanarIgnoresWhatBelongsToHeight) {
  PoseSample sample = ValidSample();
  sample.covariance(2, 2) = 0.0;
  EXPECT_FALSE(FindDefect(sample, StateSpace::kPlanar));
  EXPECT_TRUE(FindDefect(sample, StateSpace::kSpatial));
}

TEST(FindDefectTest, AcceptsRandomCovariancesThatAreNotSingular) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 1000; ++trial) {
    PoseSample sample;
    sample.covariance = RandomCovariance(random, 10.0);
    // A few draws in a hundred thousand have a pivot that rounding decides.
    // Where variances are larger by a share s, none is below s / (1 + s).
    for (int i = 0; i < 4; ++i) sample.covariance(i, i) *= 1.0 + 1e-9;
    EXPECT_FALSE(FindDefect(sample, StateSpace::kPlanar)) << trial;
    EXPECT_FALSE(FindDefect(sample, StateSpace::kSpatial)) << trial;
  }
}

TEST(IsSoundTest, SaysOfEveryCovarianceWhatFindDefectDoes) {
  std::mt19937_64 random = SeededRandom();
  const double numbers[] = {kNan, kInfinity, -1.0,   0.0,
                            1e18, 1.001e18,  1e-310, 1e-70};
  int sound = 0;
  constexpr int kTrials = 20000;
  for (int trial = 0; trial < kTrials; ++trial) {
    // From far apart to what rounding decides.
    PoseSample sample;
    sample.covariance = RandomCovariance(random, 3.0);
    Covariance& s = sample.covariance;
    const int r = UniformInt(random, 0, 3);
    const int c = UniformInt(random, 0, 3);
    const double share = std::pow(10.0, -Uniform(random, 0.0, 15.0));
    if (trial % 4 == 0) s(r, c) = numbers[trial / 4 % 8];
    if (trial % 4 == 1 && r != c) {
      s(r, c) = (1.0 - share) * std::sqrt(s(r, r) * s(c, c));
    }
    if (trial % 4 == 2) {
      for (double& entry : s.upper) entry *= std::pow(10.0, 20 * (0.5 - share));
    }
    for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
      const bool is_sound = !FindDefect(sample, space);
      sound += is_sound ? 1 : 0;
      EXPECT_EQ(IsSound(s, space), is_sound) << trial;
    }
  }
  EXPECT_GT(sound, kTrials / 2);
  EXPECT_LT(sound, 2 * kTrials - kTrials / 4);
}

TEST(FindAsymmetryTest, AllowsRoundingAndRefusesMore) {
  std::vector<double> matrix(36, 0.0);
  for (std::size_t i = 0; i < 6; ++i) matrix[7 * i] = 4.0;
  matrix[1] = 1.0;
  matrix[6] = 1.0 + 3e-9;
  EXPECT_FALSE(FindAsymmetry(matrix.data(), 6));
  matrix[6] = 1.0 + 5e-9;
  const auto defect = FindAsymmetry(matrix.data(), 6);
  ASSERT_TRUE(defect);
  EXPECT_EQ(defect->kind, DefectKind::kNotSymmetric);
  EXPECT_THAT(defect->description, HasSubstr("row 0 column 1"));
  matrix[35] = kNan;
  EXPECT_EQ(FindAsymmetry(matrix.data(), 6)->kind, DefectKind::kNotFinite);
}

}  // namespace
}  // namespace revisit::core
