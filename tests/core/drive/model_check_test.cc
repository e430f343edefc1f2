#include "core/drive/model_check.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <random>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/findings.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::Optional;

constexpr CorrelationModel kModels[] = {
    CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
    CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes};

// There and back, so that reckoning becomes more certain where it began.
std::vector<Pose> ThereAndBack(double meters) {
  return Trip()
      .Winding(0.0, 0.5 * meters)
      .Turn(180.0, 8.0)
      .Winding(0.0, 0.5 * meters)
      .poses();
}

constexpr double kMaxStep = 100.0;

std::vector<PoseSample> Reckoned(std::mt19937_64& random, double meters) {
  const oracle::Noise noise;
  return oracle::WithCovariances(
      oracle::DrawEstimate(ThereAndBack(meters), noise, random), noise);
}

// Fixes every `spacing` metres with these standard deviations, whose errors
// keep `kept` of themselves from one to the next.
std::vector<PoseSample> Fixes(std::mt19937_64& random, double meters,
                              int spacing, double sigma, double kept) {
  std::vector<Pose> fixes;
  double x = Normal(random, sigma);
  double y = Normal(random, sigma);
  int since = 0;
  for (Pose pose : ThereAndBack(meters)) {
    if (since++ % spacing != 0) continue;
    const double fresh = sigma * std::sqrt(1.0 - kept * kept);
    x = kept * x + Normal(random, fresh);
    y = kept * y + Normal(random, fresh);
    pose.x += x;
    pose.y += y;
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.05));
    fixes.push_back(pose);
  }
  return WithDeviations(fixes, sigma, 0.05);
}

ModelCheck CheckOf(const std::vector<PoseSample>& samples) {
  ModelCheck check;
  for (const PoseSample& sample : samples) check.Look(sample, kMaxStep);
  return check;
}

TEST(ModelCheckTest, HonestVehiclesOfEveryModelHaveNoFinding) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 20; ++trial) {
    ModelCheck reckoning;
    for (const PoseSample& sample : Reckoned(random, 4000.0)) {
      reckoning.Look(sample, kMaxStep);
      EXPECT_FALSE(reckoning.Judge(CorrelationModel::kDeadReckoning));
    }
    const double sigma = std::exp(Uniform(random, std::log(0.1), std::log(20)));
    ModelCheck fixes;
    for (const PoseSample& sample : Fixes(random, 4000.0, 8, sigma, 0.0)) {
      fixes.Look(sample, kMaxStep);
      EXPECT_FALSE(fixes.Judge(CorrelationModel::kIndependent));
    }
    ModelCheck correlated;
    for (const PoseSample& sample : Fixes(random, 4000.0, 8, sigma, 0.97)) {
      correlated.Look(sample, kMaxStep);
      EXPECT_FALSE(correlated.Judge(CorrelationModel::kCorrelatedFixes));
    }
  }
}

TEST(ModelCheckTest, FixesUnderDeadReckoningAreFoundWithinTwoKilometres) {
  std::mt19937_64 random = SeededRandom();
  for (const double kept : {0.0, 0.97}) {
    for (const int spacing : {1, 8}) {
      const auto finding = CheckOf(Fixes(random, 2000.0, spacing, 3.0, kept))
                               .Find(CorrelationModel::kDeadReckoning);
      ASSERT_TRUE(finding);
      EXPECT_EQ(finding->code, FindingCode::kCovariancesDoNotGrow);
      EXPECT_EQ(finding->growing, 0.0);
      ASSERT_TRUE(finding->smoother);
      // Which of the two models of fixes would be right.
      EXPECT_EQ(*finding->smoother < 3.0, kept == 0.0) << *finding->smoother;
    }
  }
}

TEST(ModelCheckTest, CovariancesThatComeAndGoDoNotGrow) {
  std::mt19937_64 random = SeededRandom();
  std::vector<PoseSample> samples = Fixes(random, 4000.0, 8, 3.0, 0.0);
  for (PoseSample& sample : samples) {
    const double factor = Uniform(random, 0.5, 5.0);
    for (double& entry : sample.covariance.upper) entry *= factor;
  }
  const ModelCheck check = CheckOf(samples);
  EXPECT_THAT(check.Judge(CorrelationModel::kDeadReckoning),
              Optional(FindingCode::kCovariancesDoNotGrow));
  EXPECT_FALSE(check.Judge(CorrelationModel::kIndependent));
  EXPECT_NEAR(check.Find(CorrelationModel::kDeadReckoning)->growing, 0.5, 0.2);
}

TEST(ModelCheckTest, ReckoningUnderAModelOfFixesIsFound) {
  std::mt19937_64 random = SeededRandom();
  const ModelCheck check = CheckOf(Reckoned(random, 2000.0));
  for (const CorrelationModel model :
       {CorrelationModel::kIndependent, CorrelationModel::kCorrelatedFixes}) {
    EXPECT_THAT(check.Judge(model), Optional(FindingCode::kCovariancesGrow));
    EXPECT_EQ(check.Find(model)->growing, 1.0);
  }
}

TEST(ModelCheckTest, CorrelatedErrorsClaimedIndependentAreFound) {
  std::mt19937_64 random = SeededRandom();
  const auto finding = CheckOf(Fixes(random, 2000.0, 8, 10.0, 0.97))
                           .Find(CorrelationModel::kIndependent);
  ASSERT_TRUE(finding);
  EXPECT_EQ(finding->code, FindingCode::kErrorsCorrelated);
  // 1 / sqrt((1 - rho)(3 - rho) / 3) is 7.0 on a straight road.
  EXPECT_NEAR(finding->smoother.value_or(0.0), 6.5, 1.5);
}

TEST(ModelCheckTest, VehiclesOfFiltersHaveNoFinding) {
  std::mt19937_64 random = SeededRandom();
  for (const double kept : {0.0, 0.97}) {
    EXPECT_FALSE(CheckOf(Fixes(random, 2000.0, 8, 3.0, kept))
                     .Judge(CorrelationModel::kFilter));
  }
}

TEST(ModelCheckTest, StandingStillTellsNothing) {
  std::vector<PoseSample> samples =
      WithDeviations(std::vector<Pose>(100'000), 3.0, 0.05);
  for (const CorrelationModel model : kModels) {
    EXPECT_FALSE(CheckOf(samples).Judge(model));
  }
}

TEST(ModelCheckTest, JumpsTellNothing) {
  std::vector<Pose> poses;
  for (int i = 0; i < 1000; ++i) poses.push_back({200.0 * i, 0.0, 0.0, 0.0});
  const ModelCheck check = CheckOf(WithDeviations(poses, 3.0, 0.05));
  for (const CorrelationModel model : kModels) {
    EXPECT_FALSE(check.Judge(model));
  }
}

TEST(ModelCheckTest, StretchesAreAsLongAsTheirRootedLengthSays) {
  std::mt19937_64 random = SeededRandom();
  const double limit = ModelCheck::kStretchMeters;
  ModelCheck check;
  PoseSample start;
  start.covariance(0, 0) = start.covariance(1, 1) = 1.0;
  check.Look(start, kMaxStep);
  const double kept = 1.0 - 1.0 / ModelCheck::kLastStretches;
  double counted = 0.0;
  double growing = 0.0;
  int too_short = 0;
  for (int i = 0; i < 10'000; ++i) {
    // Some units in the last place away from the limit, or none.
    const double turn = Uniform(random, -kPi, kPi);
    PoseSample sample;
    sample.pose.x = limit * std::cos(turn);
    sample.pose.y = limit * std::sin(turn);
    for (int k = UniformInt(random, 0, 2); k > 0; --k) {
      sample.pose.x = std::nextafter(sample.pose.x, 0.0);
    }
    // Every other stretch grows.
    sample.covariance(0, 0) = sample.covariance(1, 1) = i % 2 == 0 ? 2.0 : 0.5;
    check.Look(sample, kMaxStep);
    if (std::hypot(sample.pose.x, sample.pose.y) < limit) {
      ++too_short;
      continue;
    }
    counted = kept * counted + 1.0;
    growing = kept * growing + (i % 2 == 0 ? 1.0 : 0.0);
    // The next stretch begins at the origin again.
    check.Skip();
    check.Look(start, kMaxStep);
  }
  EXPECT_GT(too_short, 1000);
  EXPECT_LT(too_short, 9000);
  const std::optional<Finding> finding =
      check.Find(CorrelationModel::kDeadReckoning);
  ASSERT_TRUE(finding);
  EXPECT_EQ(finding->growing, growing / counted);
}

TEST(ModelCheckTest, AFindingIsGoneKilometresAfterItsCause) {
  std::mt19937_64 random = SeededRandom();
  ModelCheck check = CheckOf(Fixes(random, 3000.0, 8, 3.0, 0.0));
  EXPECT_TRUE(check.Judge(CorrelationModel::kDeadReckoning));
  for (const PoseSample& sample : Reckoned(random, 3000.0))
    check.Look(sample, kMaxStep);
  EXPECT_FALSE(check.Judge(CorrelationModel::kDeadReckoning));
}

TEST(ModelCheckTest, TheDriveTellsAFindingOnceAndKeepsIt) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Fixes(random, 2000.0, 8, 3.0, 0.97);
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kDeadReckoning;
  Drive drive(settings);
  int told = 0;
  for (const PoseSample& sample : samples) {
    const AppendResult result = drive.Append({sample}, sample.sequence);
    if (result.findings.empty()) continue;
    ++told;
    EXPECT_EQ(result.findings[0].code, FindingCode::kCovariancesDoNotGrow);
    EXPECT_LT(drive.travelled_meters(), 2000.0);
  }
  EXPECT_EQ(told, 1);
  ASSERT_EQ(drive.findings().size(), 1u);

  // A function of the poses and the model, however the poses came.
  Drive at_once(settings);
  EXPECT_EQ(at_once.Append(samples, 1).findings.size(), 1u);
  EXPECT_EQ(at_once.findings()[0].growing, drive.findings()[0].growing);
  EXPECT_EQ(at_once.findings()[0].smoother, drive.findings()[0].smoother);
  settings.search.correlation_model = CorrelationModel::kIndependent;
  Drive independent(settings);
  independent.Append(samples, 1);
  EXPECT_EQ(independent.findings()[0].code, FindingCode::kErrorsCorrelated);
  settings.search.correlation_model = CorrelationModel::kCorrelatedFixes;
  EXPECT_TRUE(independent.ChangeSettings(settings, 2).ok());
  EXPECT_TRUE(independent.findings().empty());
}

TEST(ModelCheckTest, ClaimsOfReckoningWithoutTheirCrossTermsHaveNoLever) {
  std::mt19937_64 random = SeededRandom();
  std::vector<PoseSample> samples = Reckoned(random, 3000.0);
  for (PoseSample& sample : samples) {
    sample.covariance(0, 3) = sample.covariance(1, 3) = 0.0;
  }
  const ModelCheck check = CheckOf(samples);
  EXPECT_THAT(check.Judge(CorrelationModel::kDeadReckoning),
              Optional(FindingCode::kCovariancesWithoutLever));
  // A filter says itself how its errors go on.
  EXPECT_FALSE(check.Judge(CorrelationModel::kFilter));
  // Half of them is not nearly all.
  const std::vector<PoseSample> with_lever = Reckoned(random, 3000.0);
  for (std::size_t i = 0; i < samples.size(); i += 2) {
    samples[i].covariance = with_lever[i].covariance;
  }
  EXPECT_NE(CheckOf(samples).Judge(CorrelationModel::kDeadReckoning),
            std::optional<FindingCode>(FindingCode::kCovariancesWithoutLever));
}

}  // namespace
}  // namespace revisit::core
