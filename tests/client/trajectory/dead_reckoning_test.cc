#include "client/trajectory/dead_reckoning.h"

#include <cmath>
#include <random>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

Drive MakeDrive(const std::vector<PlanarPose>& poses) {
  Drive drive;
  drive.name = "made";
  for (const PlanarPose& pose : poses) {
    Sample sample;
    sample.estimate = pose;
    drive.samples.push_back(sample);
  }
  return drive;
}

TEST(DeadReckoningTest, StartsWithTheStartsUncertainty) {
  UncertaintyOptions options;
  options.start_position = 0.2;
  options.start_heading = 0.03;
  const auto claims = ClaimUncertainty(MakeDrive({{5, 6, 1}}), options);
  ASSERT_TRUE(claims.ok());
  EXPECT_THAT((*claims)[0].planar,
              ::testing::Pointwise(::testing::DoubleNear(1e-15),
                                   {0.04, 0.0, 0.0, 0.04, 0.0, 0.0009}));
  EXPECT_NEAR((*claims)[0].z_variance, 0.04, 1e-15);
}

TEST(DeadReckoningTest, GrowsAsWorkedOutByHandOnAStraightPath) {
  UncertaintyOptions options;
  options.along = 0.1;
  options.across = 0.05;
  options.heading = 0.01;
  options.up = 0.2;
  options.start_position = 0.0;
  options.start_heading = 0.0;
  // Two steps of 10 m along x. Step noise: along 0.01 * 10, across 0.0025 * 10,
  // heading 1e-4 * 10; the first step's heading error swings the second.
  const auto claims =
      ClaimUncertainty(MakeDrive({{0, 0, 0}, {10, 0, 0}, {20, 0, 0}}), options);
  ASSERT_TRUE(claims.ok());
  const auto& p = (*claims)[2].planar;
  EXPECT_NEAR(p[0], 0.2, 1e-12);
  EXPECT_NEAR(p[1], 0.0, 1e-12);
  EXPECT_NEAR(p[2], 0.0, 1e-12);
  EXPECT_NEAR(p[3], 0.05 + 100.0 * 1e-3, 1e-12);
  EXPECT_NEAR(p[4], 10.0 * 1e-3, 1e-12);
  EXPECT_NEAR(p[5], 2e-3, 1e-12);
  EXPECT_NEAR((*claims)[2].z_variance, 0.04 * 20.0, 1e-12);
}

TEST(DeadReckoningTest, ClaimsTheHeightOfAFixAsItsFileStatesIt) {
  UncertaintyOptions options;
  options.source = UncertaintyOptions::Source::kFixes;
  options.claimed_scale = 2.0;
  Drive drive = MakeDrive({{0, 0, 0}, {10, 0, 0}});
  for (Sample& sample : drive.samples) sample.heading_variance = 0.01;
  drive.samples[0].covariance = {4.0, 0.0, 0.0, 4.0, 0.0, 0.01};
  drive.samples[0].height_covariance = {1.0, -2.0, 9.0};
  const auto claims = ClaimUncertainty(drive, options);
  ASSERT_TRUE(claims.ok()) << claims.status();
  EXPECT_EQ((*claims)[0].z_variance, 36.0);
  EXPECT_THAT((*claims)[0].z_mixed, ::testing::ElementsAre(4.0, -8.0, 0.0));
  // The second states nothing of its position.
  EXPECT_EQ((*claims)[1].z_variance, 100.0);
  EXPECT_THAT((*claims)[1].z_mixed, ::testing::ElementsAre(0.0, 0.0, 0.0));
}

TEST(DeadReckoningTest, ScalesEveryClaimedStandardDeviation) {
  UncertaintyOptions options;
  const Drive drive = MakeDrive({{0, 0, 0}, {10, 0, 0.3}, {15, 9, 1}});
  const auto honest = ClaimUncertainty(drive, options);
  options.claimed_scale = 0.5;
  const auto overconfident = ClaimUncertainty(drive, options);
  ASSERT_TRUE(honest.ok() && overconfident.ok());
  for (std::size_t i = 0; i < honest->size(); ++i) {
    for (std::size_t k = 0; k < 6; ++k) {
      EXPECT_EQ((*overconfident)[i].planar[k], 0.25 * (*honest)[i].planar[k]);
    }
    EXPECT_EQ((*overconfident)[i].z_variance, 0.25 * (*honest)[i].z_variance);
  }
}

TEST(DeadReckoningTest, TakesFixesAsTheyAre) {
  Drive drive = MakeDrive({{0, 0, 0}, {10, 0, 0}});
  const std::array<double, 6> claimed = {4.0, 1.0, 0.0, 9.0, 0.0, 0.01};
  for (Sample& sample : drive.samples) sample.covariance = claimed;
  UncertaintyOptions options;
  options.source = UncertaintyOptions::Source::kFixes;
  const auto claims = ClaimUncertainty(drive, options);
  ASSERT_TRUE(claims.ok());
  EXPECT_EQ((*claims)[0].planar, claimed);
  EXPECT_EQ((*claims)[1].planar, claimed);
  drive.samples[1].covariance.reset();
  EXPECT_EQ(ClaimUncertainty(drive, options).status().code(),
            absl::StatusCode::kInvalidArgument);
}

TEST(DeadReckoningTest, AddsNothingWhileStandingStill) {
  const auto claims =
      ClaimUncertainty(MakeDrive({{0, 0, 0}, {3, 4, 1}, {3, 4, 1}, {3, 4, 1}}),
                       UncertaintyOptions());
  ASSERT_TRUE(claims.ok());
  EXPECT_EQ((*claims)[1].planar, (*claims)[3].planar);
}

// The formula against what it is a formula of: draws of the noise.
TEST(DeadReckoningTest, IsTheCovarianceOfDrawnErrors) {
  constexpr unsigned kSeed = 20100927;
  SCOPED_TRACE("seed " + std::to_string(kSeed));
  std::vector<PlanarPose> poses = {{0, 0, 0.3}};
  for (int i = 0; i < 40; ++i) {
    PlanarPose next = poses.back();
    const double turn = i < 20 ? 0.08 : -0.05;
    next.x += 2.0 * std::cos(next.heading + 0.5 * turn);
    next.y += 2.0 * std::sin(next.heading + 0.5 * turn);
    next.heading += turn;
    poses.push_back(next);
  }
  UncertaintyOptions options;
  options.heading = 0.002;
  const auto claims = ClaimUncertainty(MakeDrive(poses), options);
  ASSERT_TRUE(claims.ok());

  std::mt19937_64 random(kSeed);
  std::normal_distribution<double> normal;
  constexpr int kDraws = 20'000;
  std::array<double, 6> sums{};
  for (int draw = 0; draw < kDraws; ++draw) {
    double x = options.start_position * normal(random);
    double y = options.start_position * normal(random);
    double h = options.start_heading * normal(random);
    for (std::size_t i = 1; i < poses.size(); ++i) {
      const double dx = poses[i].x - poses[i - 1].x;
      const double dy = poses[i].y - poses[i - 1].y;
      const double root = std::sqrt(std::hypot(dx, dy));
      const double along = options.along * root * normal(random);
      const double across = options.across * root * normal(random);
      const double direction = std::atan2(dy, dx);
      // The error so far turns the step.
      x += dx * std::cos(h) - dy * std::sin(h) - dx +
           along * std::cos(direction) - across * std::sin(direction);
      y += dx * std::sin(h) + dy * std::cos(h) - dy +
           along * std::sin(direction) + across * std::cos(direction);
      h += options.heading * root * normal(random);
    }
    const std::array<double, 6> products = {x * x, x * y, x * h,
                                            y * y, y * h, h * h};
    for (std::size_t i = 0; i < 6; ++i) sums[i] += products[i] / kDraws;
  }
  const auto& claimed = claims->back().planar;
  const double sigma_x = std::sqrt(claimed[0]);
  const double sigma_y = std::sqrt(claimed[3]);
  const double sigma_h = std::sqrt(claimed[5]);
  const std::array<double, 6> scales = {sigma_x * sigma_x, sigma_x * sigma_y,
                                        sigma_x * sigma_h, sigma_y * sigma_y,
                                        sigma_y * sigma_h, sigma_h * sigma_h};
  // Three standard errors of a sample variance.
  const double tolerance = 3.0 * std::sqrt(2.0 / kDraws);
  for (std::size_t i = 0; i < 6; ++i) {
    EXPECT_NEAR(sums[i] / scales[i], claimed[i] / scales[i], tolerance)
        << "entry " << i;
  }
}

TEST(DeadReckoningTest, AddsTheCarriedStartToTheFilesColumns) {
  Drive drive = MakeDrive({{0, 0, 0}, {10, 0, 0}});
  drive.samples[0].covariance = {0, 0, 0, 0, 0, 0};
  drive.samples[1].covariance = {1, 2, 3, 4, 5, 6};
  UncertaintyOptions options;
  options.source = UncertaintyOptions::Source::kFile;
  options.start_position = 0.1;
  options.start_heading = 0.01;
  const auto claims = ClaimUncertainty(drive, options);
  ASSERT_TRUE(claims.ok());
  EXPECT_THAT((*claims)[0].planar,
              ::testing::Pointwise(::testing::DoubleNear(1e-15),
                                   {0.01, 0.0, 0.0, 0.01, 0.0, 1e-4}));
  // The start's heading error swings the 10 m.
  EXPECT_THAT((*claims)[1].planar,
              ::testing::Pointwise(
                  ::testing::DoubleNear(1e-12),
                  {1.01, 2.0, 3.0, 4.01 + 0.01, 5.0 + 1e-3, 6.0 + 1e-4}));
}

TEST(DeadReckoningTest, RefusesAFileWithoutColumnsWhereTheyAreAskedFor) {
  UncertaintyOptions options;
  options.source = UncertaintyOptions::Source::kFile;
  EXPECT_EQ(
      ClaimUncertainty(MakeDrive({{0, 0, 0}}), options).status(),
      absl::InvalidArgumentError(
          "made: has no covariance (columns pxx, pxy, pxt, pyy, pyt, ptt, or "
          "what "
          "the format has in their place); --uncertainty model makes one"));
}

TEST(DeadReckoningTest, GeodeticFixesWithAHeadingNeedNoCovariance) {
  Drive drive = MakeDrive({{0, 0, 0}});
  drive.samples[0].geodetic = {48.0, 11.0, 500.0};
  UncertaintyOptions options;
  options.source = UncertaintyOptions::Source::kFixes;
  options.fix_position = 0.5;
  options.start_heading = 0.02;
  const auto claims = ClaimUncertainty(drive, options);
  ASSERT_TRUE(claims.ok()) << claims.status();
  EXPECT_THAT((*claims)[0].planar,
              ::testing::Pointwise(::testing::DoubleNear(1e-15),
                                   {0.25, 0.0, 0.0, 0.25, 0.0, 4e-4}));
}

TEST(DeadReckoningTest, ScaledClaimsAreThoseOfTheScale) {
  Drive drive;
  for (int i = 0; i < 3; ++i) {
    drive.samples.emplace_back();
    drive.samples.back().estimate = {10.0 * i, 2.0 * i * i, 0.1 * i};
  }
  UncertaintyOptions options;
  auto claims = ClaimUncertainty(drive, options);
  ASSERT_TRUE(claims.ok());
  ScaleClaims(0.25, &*claims);
  options.claimed_scale = 0.25;
  const auto expected = ClaimUncertainty(drive, options);
  ASSERT_TRUE(expected.ok());
  ASSERT_EQ(claims->size(), expected->size());
  for (std::size_t i = 0; i < claims->size(); ++i) {
    EXPECT_EQ((*claims)[i].planar, (*expected)[i].planar);
    EXPECT_EQ((*claims)[i].z_variance, (*expected)[i].z_variance);
  }
  // A standard deviation of 0.1 m becomes one of 0.025 m.
  EXPECT_NEAR((*claims)[0].planar[0], 0.000625, 1e-15);
}

TEST(DeadReckoningTest, ErrorsBeginAnewInAFrameOfItsOwn) {
  for (const auto source : {UncertaintyOptions::Source::kModel,
                            UncertaintyOptions::Source::kFile}) {
    UncertaintyOptions options;
    options.source = source;
    options.start_is_given = true;
    options.start_position = 0.5;
    Drive drive = MakeDrive({{0, 0, 0}, {50, 0, 0}, {100, 0, 0}});
    for (Sample& sample : drive.samples) {
      const double variance = 0.01 * sample.estimate.x;
      sample.covariance = {variance, 0.0, 0.0, variance, 0.0, 1e-3 * variance};
    }
    UncertaintyClaims claims(options, "a.csv");
    std::vector<std::array<double, 6>> first;
    for (const Sample& sample : drive.samples) {
      first.push_back(claims.Next(sample)->planar);
    }
    claims.BeginRecording("b.csv");
    claims.BeginFrame();
    for (std::size_t i = 0; i < drive.samples.size(); ++i) {
      EXPECT_EQ(claims.Next(drive.samples[i])->planar, first[i]);
    }
  }
}

}  // namespace
}  // namespace revisit::client
