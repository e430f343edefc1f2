#include "client/evaluation/simulation.h"

#include <cmath>

#include "client/formats/angles.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

// A bend of steps of 2 m.
Drive Bend() {
  Drive drive;
  drive.name = "bend";
  PlanarPose pose = {5.0, -3.0, 0.4};
  for (int i = 0; i < 60; ++i) {
    Sample sample;
    sample.time_nanoseconds = i;
    // The drive as simulated has neither of the two.
    sample.estimate = {1e3, 1e3, 1.0};
    sample.covariance = {1.0, 0.0, 0.0, 1.0, 0.0, 1.0};
    drive.samples.push_back(sample);
    drive.truth.push_back(pose);
    const double turn = i < 30 ? 0.05 : -0.03;
    pose.x += 2.0 * std::cos(pose.heading + 0.5 * turn);
    pose.y += 2.0 * std::sin(pose.heading + 0.5 * turn);
    pose.heading += turn;
  }
  return drive;
}

UncertaintyOptions NoNoise() {
  UncertaintyOptions noise;
  noise.along = noise.across = noise.heading = noise.up = 0.0;
  noise.start_position = noise.start_heading = 0.0;
  return noise;
}

TEST(SimulationTest, DrawsTheSameNumbersEverywhere) {
  // The standard fixes the generator: its 10,000th number from the default
  // seed. The rest is Box-Muller in Python on these numbers:
  //   u = ((x >> 11) + 1) / 2^53, r = sqrt(-2 ln u1), r cos(2 pi u2), r
  //   sin(...)
  std::mt19937_64 standard;
  standard.discard(9999);
  EXPECT_EQ(standard(), 9981545732273789042u);
  RandomSource normal(1);
  const double first = normal.Next();
  const double second = normal.Next();
  const double third = normal.Next();
  EXPECT_NEAR(first, 1.312851528985561, 1e-12);
  EXPECT_NEAR(second, 1.5159465040060633, 1e-12);
  EXPECT_NEAR(third, 1.2506039211781215, 1e-12);
}

TEST(SimulationTest, DrawsAStandardNormalDistribution) {
  constexpr std::uint64_t kSeed = 20100927;
  SCOPED_TRACE("seed " + std::to_string(kSeed));
  constexpr int kDraws = 200'000;
  RandomSource normal(kSeed);
  double sum = 0.0;
  double squares = 0.0;
  double fourths = 0.0;
  int beyond = 0;
  for (int i = 0; i < kDraws; ++i) {
    const double value = normal.Next();
    sum += value;
    squares += value * value;
    fourths += value * value * value * value;
    beyond += std::abs(value) > 1.959963984540054 ? 1 : 0;
  }
  // Five standard deviations of each estimate.
  EXPECT_NEAR(sum / kDraws, 0.0, 5.0 / std::sqrt(kDraws));
  EXPECT_NEAR(squares / kDraws, 1.0, 5.0 * std::sqrt(2.0 / kDraws));
  EXPECT_NEAR(fourths / kDraws, 3.0, 5.0 * std::sqrt(96.0 / kDraws));
  EXPECT_NEAR(beyond, 0.05 * kDraws, 5.0 * std::sqrt(0.0475 * kDraws));
}

TEST(SimulationTest, FollowsTheTruthWithoutNoise) {
  const Drive drive = Bend();
  const Drive simulated = SimulateDeadReckoning(drive, NoNoise(), 3);
  ASSERT_EQ(simulated.samples.size(), drive.samples.size());
  for (std::size_t i = 0; i < drive.truth.size(); ++i) {
    const PlanarPose& estimate = simulated.samples[i].estimate;
    EXPECT_NEAR(estimate.x, drive.truth[i].x, 1e-9) << i;
    EXPECT_NEAR(estimate.y, drive.truth[i].y, 1e-9) << i;
    EXPECT_NEAR(
        std::remainder(estimate.heading - drive.truth[i].heading, 2.0 * kPi),
        0.0, 1e-9)
        << i;
    EXPECT_EQ(simulated.samples[i].time_nanoseconds,
              static_cast<std::int64_t>(i));
    EXPECT_FALSE(simulated.samples[i].covariance.has_value());
  }
}

TEST(SimulationTest, DrawsHeightsAboutTheTruthAndLeavesThePlaneAsItWas) {
  const Drive flat = Bend();
  Drive hill = flat;
  for (std::size_t i = 0; i < hill.samples.size(); ++i) {
    hill.samples[i].truth_z = 0.1 * static_cast<double>(i);
  }
  EXPECT_NEAR(SimulateDeadReckoning(hill, NoNoise(), 3).samples[59].z, 5.9,
              1e-12);
  const UncertaintyOptions noise;
  double squares = 0.0;
  constexpr int kSeeds = 500;
  for (std::uint64_t seed = 1; seed <= kSeeds; ++seed) {
    const Drive drawn = SimulateDeadReckoning(hill, noise, seed);
    const Drive on_plane = SimulateDeadReckoning(flat, noise, seed);
    const double error = drawn.samples[59].z - 5.9;
    squares += error * error;
    EXPECT_EQ(drawn.samples[59].estimate.x, on_plane.samples[59].estimate.x);
    EXPECT_NEAR(on_plane.samples[59].z, error, 1e-12);
  }
  // 118 m of 0.05 m per square root of a metre, and 0.1 m at the start; five
  // standard deviations of the estimate.
  const double variance = 0.05 * 0.05 * 118.0 + 0.01;
  EXPECT_NEAR(squares / kSeeds, variance,
              5.0 * variance * std::sqrt(2.0 / kSeeds));
}

TEST(SimulationTest, StandsStillWithTheVehicleAndLosesNoMotion) {
  Drive drive;
  drive.name = "creep";
  for (int i = 0; i < 101; ++i) {
    drive.samples.emplace_back();
    drive.truth.push_back({0.02 * i, 0.0, 0.0});
  }
  const Drive simulated = SimulateDeadReckoning(drive, NoNoise(), 3);
  // Three steps of 2 cm are the first that count.
  EXPECT_EQ(simulated.samples[2].estimate.x, 0.0);
  EXPECT_NEAR(simulated.samples[3].estimate.x, 0.06, 1e-12);
  EXPECT_EQ(simulated.samples[4].estimate.x, simulated.samples[3].estimate.x);
  EXPECT_NEAR(simulated.samples[99].estimate.x, 1.98, 1e-12);
}

// This drive goes along x at 10 m/s, with ten poses a second.
Drive Straight(int poses) {
  Drive drive;
  drive.name = "straight";
  for (int i = 0; i < poses; ++i) {
    Sample sample;
    sample.time_nanoseconds = 100'000'000 * static_cast<std::int64_t>(i);
    sample.estimate = {1.0 * i, 0.0, 0.0};
    sample.covariance = {1.0, 0.0, 0.0, 1.0, 0.0, 1.0};
    drive.samples.push_back(sample);
    drive.truth.push_back(sample.estimate);
  }
  return drive;
}

TEST(SimulationTest, BiasOfAGyroBendsAStraightIntoAnArc) {
  Drive drive = Straight(101);
  AddGyroBias(0.02, &drive);
  // In 10 s the estimate turns by 0.2 rad, on a circle of 500 m of radius.
  const PlanarPose& end = drive.samples.back().estimate;
  EXPECT_NEAR(end.heading, 0.2, 1e-12);
  EXPECT_NEAR(end.x, 500.0 * std::sin(0.2), 1e-4);
  EXPECT_NEAR(end.y, 500.0 * (1.0 - std::cos(0.2)), 1e-4);
  EXPECT_EQ(drive.truth.back().x, 100.0);
  EXPECT_FALSE(drive.samples.back().covariance.has_value());
}

TEST(SimulationTest, BiasTurnsByTimeAndTakesATenthOfASecondWhereThereIsNone) {
  constexpr std::int64_t kSecond = 1'000'000'000;
  Drive drive;
  drive.name = "stops";
  // The first gap is 2 s long and counts; the others are too long, have no
  // time, or go back, so that each takes 0.1 s.
  const std::optional<std::int64_t> times[] = {
      0, 2 * kSecond, 5 * kSecond, std::nullopt, 6 * kSecond, 5 * kSecond};
  const double headings[] = {0.0, 0.2, 0.21, 0.22, 0.23, 0.24};
  for (const auto& time : times) {
    drive.samples.emplace_back();
    drive.samples.back().time_nanoseconds = time;
    drive.samples.back().estimate = {7.0, 8.0, 1.0};
  }
  AddGyroBias(0.1, &drive);
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    const PlanarPose& estimate = drive.samples[i].estimate;
    EXPECT_EQ(estimate.x, 7.0) << i;
    EXPECT_EQ(estimate.y, 8.0) << i;
    EXPECT_NEAR(estimate.heading, 1.0 + headings[i], 1e-12) << i;
  }
}

TEST(SimulationTest, NoBiasLeavesAnEstimateAsItIs) {
  Drive drive = Bend();
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    drive.samples[i].estimate = drive.truth[i];
  }
  AddGyroBias(0.0, &drive);
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    EXPECT_NEAR(drive.samples[i].estimate.x, drive.truth[i].x, 1e-9);
    EXPECT_NEAR(drive.samples[i].estimate.y, drive.truth[i].y, 1e-9);
  }
}

TEST(SimulationTest, FixesComeEachSecondAndClaimTheirDeviations) {
  const Drive fixes = SimulateFixes(Straight(101), {3.0, 60.0, 0.05}, 1);
  ASSERT_EQ(fixes.samples.size(), 11u);
  ASSERT_EQ(fixes.truth.size(), 11u);
  EXPECT_EQ(fixes.name, "straight");
  for (std::size_t i = 0; i < fixes.samples.size(); ++i) {
    EXPECT_EQ(fixes.truth[i].x, 10.0 * static_cast<double>(i));
    EXPECT_EQ(fixes.samples[i].time_nanoseconds,
              static_cast<std::int64_t>(i) * 1'000'000'000);
    EXPECT_THAT(*fixes.samples[i].covariance,
                ElementsAre(9.0, 0.0, 0.0, 9.0, 0.0, 0.05 * 0.05));
  }
}

TEST(SimulationTest, VehicleThatStandsGetsNoFixes) {
  Drive drive = Straight(101);
  // It stands from 2 s to 8 s.
  for (std::size_t i = 20; i <= 80; ++i) drive.truth[i].x = 20.0;
  for (std::size_t i = 81; i <= 100; ++i) drive.truth[i].x -= 60.0;
  const Drive fixes = SimulateFixes(drive, {3.0, 0.0, 0.05}, 1);
  std::vector<double> at;
  for (const PlanarPose& truth : fixes.truth) at.push_back(truth.x);
  EXPECT_THAT(at, ElementsAre(0.0, 10.0, 20.0, 21.0, 31.0));
}

TEST(SimulationTest, ErrorsOfFixesHaveTheirDeviationAndCorrelation) {
  constexpr int kSeconds = 40'000;
  Drive drive = Straight(10);
  drive.samples.resize(kSeconds);
  drive.truth.resize(kSeconds);
  for (int i = 0; i < kSeconds; ++i) {
    const auto at = static_cast<std::size_t>(i);
    drive.samples[at].time_nanoseconds = std::int64_t{1'000'000'000} * i;
    drive.truth[at] = {10.0 * i, 0.0, 0.3};
  }
  for (const double correlation : {0.0, 5.0}) {
    const Drive fixes = SimulateFixes(drive, {3.0, correlation, 0.05}, 4);
    ASSERT_EQ(fixes.samples.size(), drive.samples.size());
    double squares = 0.0;
    double products = 0.0;
    double headings = 0.0;
    for (std::size_t i = 1; i < fixes.samples.size(); ++i) {
      const double before =
          fixes.samples[i - 1].estimate.x - fixes.truth[i - 1].x;
      const double error = fixes.samples[i].estimate.x - fixes.truth[i].x;
      const double turn =
          fixes.samples[i].estimate.heading - fixes.truth[i].heading;
      squares += error * error;
      products += error * before;
      headings += turn * turn;
    }
    // Neighbours within 10 s tell the same, so some 4000 values are free.
    EXPECT_NEAR(std::sqrt(squares / kSeconds), 3.0, 0.2) << correlation;
    EXPECT_NEAR(products / squares,
                correlation > 0.0 ? std::exp(-1.0 / correlation) : 0.0, 0.03)
        << correlation;
    EXPECT_NEAR(std::sqrt(headings / kSeconds), 0.05, 0.002) << correlation;
  }
}

TEST(SimulationTest, FixesDifferBySeedAndName) {
  const FixNoise noise = {3.0, 60.0, 0.05};
  const Drive drive = Straight(101);
  Drive renamed = drive;
  renamed.name = "another";
  const auto end = [&](const Drive& d, std::uint64_t seed) {
    return SimulateFixes(d, noise, seed).samples.back().estimate.x;
  };
  EXPECT_EQ(end(drive, 1), end(drive, 1));
  EXPECT_NE(end(drive, 1), end(drive, 2));
  EXPECT_NE(end(drive, 1), end(renamed, 1));
}

TEST(SimulationTest, SameSeedAndNameGiveTheSameDrive) {
  const Drive drive = Bend();
  Drive renamed = drive;
  renamed.name = "another";
  const auto end = [](const Drive& d) { return d.samples.back().estimate.x; };
  const UncertaintyOptions noise;
  const Drive first = SimulateDeadReckoning(drive, noise, 1);
  EXPECT_EQ(end(first), end(SimulateDeadReckoning(drive, noise, 1)));
  EXPECT_NE(end(first), end(SimulateDeadReckoning(drive, noise, 2)));
  EXPECT_NE(end(first), end(SimulateDeadReckoning(renamed, noise, 1)));
}

TEST(SimulationTest, DrawsTheSameDriveEverywhere) {
  // Worked out in Python with complex numbers: the same generator, draws in the
  // order position, heading, then for each step along, across, heading.
  const Drive simulated =
      SimulateDeadReckoning(Bend(), UncertaintyOptions(), 1);
  const PlanarPose& end = simulated.samples.back().estimate;
  EXPECT_NEAR(end.x, 31.651083512404497, 1e-9);
  EXPECT_NEAR(end.y, 102.36859710460485, 1e-9);
  EXPECT_NEAR(end.heading, 1.036316117982025, 1e-9);
}

// Errors as drawn against those claimed along it: an honest filter.
TEST(SimulationTest, ErrorsHaveTheClaimedCovariance) {
  constexpr int kDrives = 4000;
  const Drive drive = Bend();
  UncertaintyOptions noise;
  noise.heading = 0.002;
  double normalized = 0.0;
  double xx = 0.0;
  double hh = 0.0;
  for (int seed = 1; seed <= kDrives; ++seed) {
    const Drive simulated =
        SimulateDeadReckoning(drive, noise, static_cast<std::uint64_t>(seed));
    const auto claims = ClaimUncertainty(simulated, noise);
    ASSERT_TRUE(claims.ok());
    const auto& [pxx, pxy, pxh, pyy, pyh, phh] = claims->back().planar;
    const PlanarPose& estimate = simulated.samples.back().estimate;
    const PlanarPose& truth = drive.truth.back();
    const double dx = estimate.x - truth.x;
    const double dy = estimate.y - truth.y;
    const double dh =
        std::remainder(estimate.heading - truth.heading, 2.0 * kPi);
    xx += dx * dx / pxx;
    hh += dh * dh / phh;
    // d^T P^-1 d by cofactors.
    const double det = pxx * (pyy * phh - pyh * pyh) -
                       pxy * (pxy * phh - pyh * pxh) +
                       pxh * (pxy * pyh - pyy * pxh);
    normalized +=
        (dx * dx * (pyy * phh - pyh * pyh) + dy * dy * (pxx * phh - pxh * pxh) +
         dh * dh * (pxx * pyy - pxy * pxy) +
         2.0 * dx * dy * (pxh * pyh - pxy * phh) +
         2.0 * dx * dh * (pxy * pyh - pxh * pyy) +
         2.0 * dy * dh * (pxy * pxh - pxx * pyh)) /
        det;
  }
  // Five standard deviations, and room for what first order leaves out.
  EXPECT_NEAR(xx / kDrives, 1.0, 5.0 * std::sqrt(2.0 / kDrives) + 0.02);
  EXPECT_NEAR(hh / kDrives, 1.0, 5.0 * std::sqrt(2.0 / kDrives) + 0.02);
  EXPECT_NEAR(normalized / kDrives, 3.0, 5.0 * std::sqrt(6.0 / kDrives) + 0.05);
}

TEST(SimulationTest, ReadsSeeds) {
  EXPECT_THAT(*ParseSeeds("7"), ElementsAre(7u));
  EXPECT_THAT(*ParseSeeds("2-4"), ElementsAre(2u, 3u, 4u));
  EXPECT_THAT(*ParseSeeds("9,0,2-3"), ElementsAre(9u, 0u, 2u, 3u));
  EXPECT_THAT(*ParseSeeds("18446744073709551615"),
              ElementsAre(18446744073709551615u));
}

TEST(SimulationTest, RefusesWhatIsNoSeeds) {
  for (const char* text : {"", "x", "1-", "-1", "4-2", "1,,2", "1 2", "1-2-3",
                           "18446744073709551616"}) {
    const auto seeds = ParseSeeds(text);
    EXPECT_EQ(seeds.status().code(), absl::StatusCode::kInvalidArgument)
        << text;
    EXPECT_THAT(std::string(seeds.status().message()),
                HasSubstr("expected seeds such as 7, 1-5 or 1,4,8-10"))
        << text;
  }
  EXPECT_THAT(std::string(ParseSeeds("3,1-4").status().message()),
              HasSubstr("seed 3 stands twice"));
  EXPECT_THAT(std::string(ParseSeeds("1-1001").status().message()),
              HasSubstr("at most 1000 seeds"));
  EXPECT_THAT(
      std::string(ParseSeeds("0-18446744073709551615").status().message()),
      HasSubstr("at most 1000 seeds"));
  EXPECT_EQ(ParseSeeds("1-1000")->size(), 1000u);
}

TEST(SimulationTest, DatumPutsTheStartOfAnEstimateWhereTheTruthBegins) {
  Drive drive = Bend();
  // A frame of its own.
  drive.samples[0].estimate = {40.0, 7.0, -1.0};
  const PlanarPose exact = DrawDatum(drive, 0.0, 0.0, 1);
  const auto placed = [&drive](const PlanarPose& datum) {
    const PlanarPose& start = drive.samples[0].estimate;
    const double c = std::cos(datum.heading);
    const double s = std::sin(datum.heading);
    return PlanarPose{datum.x + c * start.x - s * start.y,
                      datum.y + s * start.x + c * start.y,
                      datum.heading + start.heading};
  };
  EXPECT_NEAR(placed(exact).x, 5.0, 1e-9);
  EXPECT_NEAR(placed(exact).y, -3.0, 1e-9);
  EXPECT_NEAR(placed(exact).heading, 0.4, 1e-9);
  // Errors are those of the start, however far away the frame's origin is.
  double sum = 0.0;
  double turns = 0.0;
  constexpr int kDraws = 2000;
  for (int seed = 1; seed <= kDraws; ++seed) {
    const PlanarPose start =
        placed(DrawDatum(drive, 10.0, 0.1, static_cast<std::uint64_t>(seed)));
    sum += (start.x - 5.0) * (start.x - 5.0);
    turns += (start.heading - 0.4) * (start.heading - 0.4);
  }
  EXPECT_NEAR(std::sqrt(sum / kDraws), 10.0, 0.6);
  EXPECT_NEAR(std::sqrt(turns / kDraws), 0.1, 0.006);
  const PlanarPose once = DrawDatum(drive, 10.0, 0.1, 7);
  EXPECT_EQ(once.x, DrawDatum(drive, 10.0, 0.1, 7).x);
  drive.name = "another";
  EXPECT_NE(once.x, DrawDatum(drive, 10.0, 0.1, 7).x);
}

}  // namespace
}  // namespace revisit::client
