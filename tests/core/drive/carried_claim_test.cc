#include "core/drive/carried_claim.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <random>
#include <vector>

#include "core/drive/agreement.h"
#include "core/drive/drive.h"
#include "core/drive/measured_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/state_matrix.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using ::testing::Lt;

// The noise that constant claims stand for.
oracle::Noise UsualNoise() {
  oracle::Noise noise;
  noise.along_meters = kUsualReckoning.along;
  noise.across_meters = kUsualReckoning.across;
  noise.heading_radians = kUsualReckoning.heading;
  return noise;
}

std::vector<Pose> Road(double meters) {
  return Trip().Winding(0.0, meters).Turn(180.0, 30.0).Straight(200.0).poses();
}

// The covariance in force at each pose; nothing where that is the claim.
std::vector<std::optional<CarriedCovariance>> InForce(
    const std::vector<PoseSample>& samples,
    StateSpace space = StateSpace::kPlanar) {
  std::vector<std::optional<CarriedCovariance>> all(1);
  for (std::size_t i = 1; i < samples.size(); ++i) {
    const std::optional<CarriedCovariance>& before = all.back();
    all.push_back(CarriedClaim(
        space, {samples[i - 1].pose, samples[i - 1].covariance},
        before ? &*before : nullptr, {samples[i].pose, samples[i].covariance}));
  }
  return all;
}

// The greatest difference of entries, as a share of the two variances.
double Apart(const Covariance& a, const Covariance& b) {
  double most = 0.0;
  for (const int r : {0, 1, 3}) {
    for (const int c : {0, 1, 3}) {
      most = std::max(
          most, std::abs(a(r, c) - b(r, c)) / std::sqrt(b(r, r) * b(c, c)));
    }
  }
  return most;
}

void LeaveOutCrossTerms(Covariance* covariance) {
  (*covariance)(0, 1) = (*covariance)(0, 3) = (*covariance)(1, 3) = 0.0;
}

// The covariances that the claim before has, and those that its swing makes of
// them, tell together what is left out, in x as in y.
TEST(CarriedClaimTest, ALeverOfTheClaimBeforeIsCarriedOnWithItsSwing) {
  for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
    for (const double sign : {1.0, -1.0}) {
      ClaimedPose before;
      for (int i = 0; i < 3; ++i) before.claim(i, i) = 100.0;
      before.claim(3, 3) = 1e-4;
      ClaimedPose after = before;
      // The swing of 10 m makes a covariance of 1e-3.
      ClaimedPose ahead = before;
      before.claim(0, 3) = sign * 1e-3;
      ahead.claim(1, 3) = sign * 1e-3;
      after.pose.y = -10.0;
      ClaimedPose behind = after;
      behind.pose = {10.0, 0.0, 0.0, 0.0};
      EXPECT_EQ(CarriedClaim(space, before, nullptr, after).has_value(),
                sign > 0.0);
      EXPECT_EQ(CarriedClaim(space, ahead, nullptr, behind).has_value(),
                sign > 0.0);
    }
  }
}

TEST(CarriedClaimTest, ClaimsOfDeadReckoningCountAsTheyAre) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 20; ++trial) {
    oracle::Noise noise;
    noise.along_meters = Uniform(random, 0.01, 0.5);
    noise.across_meters = Uniform(random, 0.01, 0.5);
    noise.heading_radians = Uniform(random, 1e-4, 1e-2);
    noise.start_position_meters = Uniform(random, 0.0, 3.0) + 1e-3;
    noise.start_heading_radians = Uniform(random, 1e-4, 0.2);
    for (const std::optional<CarriedCovariance>& each :
         InForce(oracle::WithCovariances(Road(2000.0), noise))) {
      ASSERT_FALSE(each);
    }
  }
}

TEST(CarriedClaimTest, ADiagonalOfPropagatedClaimsIsPropagatedAnew) {
  for (const bool is_isotropic : {false, true}) {
    const std::vector<PoseSample> whole =
        oracle::WithCovariances(Road(2000.0), UsualNoise());
    std::vector<PoseSample> sent = whole;
    for (PoseSample& sample : sent) {
      LeaveOutCrossTerms(&sample.covariance);
      if (!is_isotropic) continue;
      sample.covariance(0, 0) = sample.covariance(1, 1) =
          0.5 * (sample.covariance(0, 0) + sample.covariance(1, 1));
    }
    const auto in_force = InForce(sent);
    for (std::size_t i = 1; i < sent.size(); ++i) {
      ASSERT_TRUE(in_force[i]) << i;
      ASSERT_THAT(Apart(in_force[i]->covariance, whole[i].covariance), Lt(0.05))
          << i;
    }
  }
}

TEST(CarriedClaimTest, ConstantClaimsGrowAsAUsualOdometerDoes) {
  const oracle::Noise noise = UsualNoise();
  const std::vector<PoseSample> whole =
      oracle::WithCovariances(Road(2000.0), noise);
  const auto in_force = InForce(WithDeviations(
      Road(2000.0), noise.start_position_meters, noise.start_heading_radians));
  for (std::size_t i = 1; i < whole.size(); ++i) {
    ASSERT_TRUE(in_force[i]) << i;
    ASSERT_THAT(Apart(in_force[i]->covariance, whole[i].covariance), Lt(0.05))
        << i;
  }
}

TEST(CarriedClaimTest, ClaimsThatGoUpAndDownAreAsConstantOnes) {
  std::mt19937_64 random = SeededRandom();
  const oracle::Noise noise = UsualNoise();
  const std::vector<PoseSample> whole =
      oracle::WithCovariances(Road(3000.0), noise);
  std::vector<PoseSample> sent = WithDeviations(
      Road(3000.0), noise.start_position_meters, noise.start_heading_radians);
  for (PoseSample& sample : sent) {
    for (const int k : {0, 1, 3}) {
      sample.covariance(k, k) *= std::exp(Normal(random, 0.6));
    }
  }
  // The first claims are soon the greatest; from then on as much is added.
  const auto in_force = InForce(sent);
  const auto grown = [](const Covariance& from, const Covariance& to) {
    return to(3, 3) - from(3, 3);
  };
  EXPECT_NEAR(grown(in_force[2000]->covariance, in_force[3000]->covariance) /
                  grown(whole[2000].covariance, whole[3000].covariance),
              1.0, 0.2);
}

TEST(CarriedClaimTest, AShareOfTheWayIsNoNoiseOfSteps) {
  // 1 % of the way in position, and a gyro of 0.1 degree in heading.
  // On a way that leads back again and again, where such claims grow on.
  std::vector<PoseSample> sent = WithDeviations(Ring(8000.0), 0.1, 0.01);
  for (std::size_t i = 0; i < sent.size(); ++i) {
    const double meters = static_cast<double>(i);
    Covariance& claim = sent[i].covariance;
    claim(0, 0) = claim(1, 1) = 0.01 + std::pow(0.01 * meters, 2.0);
    claim(3, 3) = 1e-4 + std::pow(kUsualReckoning.heading, 2.0) * meters;
  }
  const auto in_force = InForce(sent);
  // Over one step, what is carried on and at most four times the usual noise.
  const double usual = kUsualReckoning.along * kUsualReckoning.along +
                       kUsualReckoning.across * kUsualReckoning.across;
  for (std::size_t i = 2; i < sent.size(); ++i) {
    const Covariance& before = in_force[i - 1]->covariance;
    const double x = sent[i].pose.x - sent[i - 1].pose.x;
    const double y = sent[i].pose.y - sent[i - 1].pose.y;
    const double carried = before(0, 0) + before(1, 1) +
                           2.0 * (x * before(1, 3) - y * before(0, 3)) +
                           (x * x + y * y) * before(3, 3);
    const Covariance& now = in_force[i]->covariance;
    const double added = now(0, 0) + now(1, 1) - carried;
    ASSERT_GE(added, 0.99 * usual * std::hypot(x, y));
    ASSERT_LE(added, 4.01 * usual * std::hypot(x, y));
  }
}

TEST(CarriedClaimTest, ClaimsThatAreBegunAnewGoOnWhereThePoseDoes) {
  for (const bool is_diagonal : {false, true}) {
    const oracle::Noise noise = UsualNoise();
    const std::vector<Pose> road = Road(3000.0);
    const std::vector<PoseSample> whole = oracle::WithCovariances(road, noise);
    std::vector<PoseSample> sent = whole;
    for (std::size_t from = 1000; from < sent.size(); from += 1000) {
      const std::vector<PoseSample> anew = oracle::WithCovariances(
          {road.begin() + static_cast<std::ptrdiff_t>(from), road.end()},
          noise);
      for (std::size_t i = from; i < sent.size(); ++i) {
        sent[i].covariance = anew[i - from].covariance;
      }
    }
    if (is_diagonal) {
      for (PoseSample& sample : sent) LeaveOutCrossTerms(&sample.covariance);
    }
    const auto in_force = InForce(sent);
    for (std::size_t i = 1000; i < sent.size(); ++i) {
      ASSERT_TRUE(in_force[i]) << i;
      // The noise of the steps on which claims were begun is not known.
      ASSERT_THAT(Apart(in_force[i]->covariance, whole[i].covariance), Lt(0.06))
          << i;
    }
  }
}

TEST(CarriedClaimTest, ClaimsThatFallWhereThePoseLeapsCountAsTheyAre) {
  // A fix takes an error back.
  std::vector<PoseSample> sent =
      oracle::WithCovariances(Road(2000.0), UsualNoise());
  ClaimedPose before{sent.back().pose, sent.back().covariance};
  ClaimedPose after = before;
  after.claim = sent.front().covariance;
  const double given_up =
      std::sqrt(0.5 * (before.claim(0, 0) + before.claim(1, 1)));
  ASSERT_GT(given_up, 10.0);
  after.pose.x += 1.0;
  EXPECT_TRUE(IsGivenUp(before, after));
  EXPECT_TRUE(CarriedClaim(StateSpace::kPlanar, before, nullptr, after));
  after.pose.x += 0.5 * given_up;
  EXPECT_FALSE(IsGivenUp(before, after));
  EXPECT_FALSE(CarriedClaim(StateSpace::kPlanar, before, nullptr, after));
}

TEST(CarriedClaimTest, ClaimsThatHaveCaughtUpCountAgain) {
  std::vector<PoseSample> sent =
      oracle::WithCovariances(Road(2000.0), UsualNoise());
  for (std::size_t i = 0; i < sent.size(); ++i) {
    if (i < 500) {
      LeaveOutCrossTerms(&sent[i].covariance);
    } else {
      // So much less certain that no rounding decides.
      for (const int k : {0, 1, 3}) sent[i].covariance(k, k) *= 1.5;
    }
  }
  const auto in_force = InForce(sent);
  EXPECT_TRUE(in_force[499]);
  for (std::size_t i = 500; i < sent.size(); ++i) ASSERT_FALSE(in_force[i]);
}

TEST(CarriedClaimTest, WhatIsCarriedIsPositiveDefiniteInAnyStateSpace) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    std::vector<PoseSample> sent = WithDeviations(
        Road(300.0), Uniform(random, 1e-3, 10.0), Uniform(random, 1e-4, 1.0));
    for (PoseSample& sample : sent) {
      for (const int k : {0, 1, 2, 3}) {
        sample.covariance(k, k) *= std::exp(Normal(random, 1.0));
      }
    }
    for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
      const auto in_force = InForce(sent, space);
      for (std::size_t i = 0; i < sent.size(); ++i) {
        if (!in_force[i]) continue;
        PoseSample carried = sent[i];
        carried.covariance = in_force[i]->covariance;
        ASSERT_FALSE(FindDefect(carried, space)) << i;
      }
    }
  }
}

TEST(CarriedClaimTest, OnlyDriftThatIsCarriedOnIsCarried) {
  const std::vector<PoseSample> sent = WithDeviations(Road(500.0), 1.0, 0.02);
  for (const CorrelationModel model :
       {CorrelationModel::kIndependent, CorrelationModel::kCorrelatedFixes}) {
    DriveSettings settings;
    settings.search.correlation_model = model;
    Drive drive(settings);
    drive.Append(sent, 1);
    EXPECT_EQ(drive.graph().covariance(100)(0, 0), 1.0);
  }
  Drive drive((DriveSettings()));
  drive.Append(sent, 1);
  EXPECT_GT(drive.graph().covariance(100)(0, 0), 1.5);
}

TEST(CarriedClaimTest, NothingIsAddedWhereTheVehicleStands) {
  const std::vector<PoseSample> whole =
      oracle::WithCovariances(Road(500.0), UsualNoise());
  ClaimedPose sent{whole[400].pose, whole[400].covariance};
  LeaveOutCrossTerms(&sent.claim);
  const auto in_force =
      CarriedClaim(StateSpace::kPlanar,
                   {whole[400].pose, whole[400].covariance}, nullptr, sent);
  ASSERT_TRUE(in_force);
  EXPECT_THAT(Apart(in_force->covariance, whole[400].covariance), Lt(1e-12));
}

// A confirmed place whose poses were measured tells as much of the drift.
TEST(CarriedClaimTest, AMeasurementGoesByWhatIsCarriedToo) {
  const std::vector<PoseSample> whole =
      oracle::WithCovariances(Road(1000.0), UsualNoise());
  std::vector<PoseSample> sent = whole;
  for (PoseSample& sample : sent) LeaveOutCrossTerms(&sample.covariance);
  const auto agreement = [](const std::vector<PoseSample>& samples) {
    Drive drive((DriveSettings()));
    drive.Append(samples, 1);
    MeasuredLoop loop;
    loop.query = {samples[900].pose, samples[900].covariance};
    loop.matched = {samples[100].pose, samples[100].covariance};
    loop.measurement.relative =
        Compose(Inverse(loop.matched.pose), loop.query.pose);
    loop.measurement.relative.y += 20.0;
    for (const int k : {0, 1, 2, 3}) loop.measurement.covariance(k, k) = 0.01;
    return drive
        .AgreementOf(901, 101, std::make_shared<const MeasuredLoop>(loop))
        ->squared_mahalanobis;
  };
  EXPECT_NEAR(agreement(sent) / agreement(whole), 1.0, 0.05);
}

TEST(CarriedClaimTest, ADriveThatWasLoadedCarriesOn) {
  const std::vector<PoseSample> sent = WithDeviations(Road(500.0), 1.0, 0.02);
  Drive whole((DriveSettings()));
  whole.Append(sent, 1);
  for (const std::size_t at : {1u, 2u, 301u}) {
    const auto cut = sent.begin() + static_cast<std::ptrdiff_t>(at);
    Drive first((DriveSettings()));
    first.Append({sent.begin(), cut}, 1);
    Drive loaded((DriveSettings()));
    ASSERT_TRUE(loaded.LoadRest(first.SaveRest(0)));
    loaded.Append({cut, sent.end()}, 2);
    EXPECT_EQ(loaded.SaveRest(0), whole.SaveRest(0));
  }
}

}  // namespace
}  // namespace revisit::core
