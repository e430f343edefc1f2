// A measured loop closure helps the searches after it, on drives by dead
// reckoning whose noise is drawn.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <memory>
#include <vector>

#include "core/drive/agreement.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr std::size_t kMatched = 150;
// Far enough for a search whose aligned path, of two sequences, begins behind
// the closure's surroundings.
constexpr std::size_t kLaterMatched = 370;

// Two laps of a ring, of which the second lies 3 m to the left around the
// closure, and on the first one again where a later place is sought.
struct TwoLaps {
  std::vector<Pose> truth;
  std::size_t query = 0;
  std::size_t later_query = 0;

  TwoLaps() : truth(Ring(1600.0)) {
    query = SecondPass(kMatched);
    later_query = SecondPass(kLaterMatched);
    truth.resize(later_query + 1);
    for (std::size_t i = query - 60; i <= query + 60; ++i) {
      const double away =
          std::abs(static_cast<double>(i) - static_cast<double>(query));
      const double aside = 3.0 * std::clamp((60.0 - away) / 30.0, 0.0, 1.0);
      truth[i].x -= aside * std::sin(truth[i].heading);
      truth[i].y += aside * std::cos(truth[i].heading);
    }
  }

  // The pose of the second lap that is nearest to one of the first.
  std::size_t SecondPass(std::size_t first) const {
    const auto nearer = [&](const Pose& a, const Pose& b) {
      return Distance(a, truth[first], StateSpace::kPlanar) <
             Distance(b, truth[first], StateSpace::kPlanar);
    };
    const auto begin = truth.begin() + static_cast<std::ptrdiff_t>(first) + 500;
    return static_cast<std::size_t>(
        std::min_element(begin, truth.end(), nearer) - truth.begin());
  }

  // The query as seen from the match.
  Pose Relative() const {
    const Pose& m = truth[kMatched];
    const Pose apart = Difference(truth[query], m);
    const double c = std::cos(m.heading);
    const double s = std::sin(m.heading);
    return {c * apart.x + s * apart.y, c * apart.y - s * apart.x, 0.0,
            apart.heading};
  }
};

std::shared_ptr<const MeasuredLoop> Measured(
    const TwoLaps& laps, const std::vector<PoseSample>& samples,
    const Pose& relative) {
  MeasuredLoop loop;
  loop.query = {samples[laps.query].pose, samples[laps.query].covariance};
  loop.matched = {samples[kMatched].pose, samples[kMatched].covariance};
  loop.measurement.relative = relative;
  for (int k : {0, 1, 2}) loop.measurement.covariance(k, k) = 0.2 * 0.2;
  loop.measurement.covariance(3, 3) = 0.02 * 0.02;
  return std::make_shared<const MeasuredLoop>(loop);
}

// The answer of a search at the later place, as to the best right candidate.
struct Found {
  // Log-odds against places not seen before.
  double score = 0.0;
  double squared_end_difference = 0.0;
};

Found FindAfter(const TwoLaps& laps, const std::vector<PoseSample>& samples,
                const std::shared_ptr<const MeasuredLoop>& measured) {
  Drive drive(DriveSettings{});
  drive.Append(samples, 1);
  drive.AddLoopClosure(laps.query + 1, kMatched + 1, 2, measured);
  SearchOptions options = drive.settings().search;
  options.exhaustive = true;
  options.sequence_length_meters = 75.0;
  // The closure is all that is known of the drift.
  options.use_belief = false;
  const auto set = Search(&drive).AtEnd(options, nullptr);
  for (const Candidate& candidate : set->candidates) {
    const Node node = drive.graph().node(candidate.matched);
    const double off = static_cast<double>(node.sequence) - 1.0 -
                       static_cast<double>(kLaterMatched);
    if (std::abs(off) > 10.0) continue;
    return {candidate.score, candidate.relative->squared_end_difference};
  }
  ADD_FAILURE() << "the right place was not found";
  return {};
}

TEST(DriveMeasuredTest, MeasuredOffsetIsBetterThanOnePlaceAndThanNoOffset) {
  const TwoLaps laps;
  ASSERT_NEAR(std::hypot(laps.Relative().x, laps.Relative().y), 3.0, 0.6);
  oracle::Noise noise;
  noise.along_meters = 0.1;
  noise.heading_radians = 0.0005;
  std::mt19937_64 random = SeededRandom();
  // The means lie four standard errors and more from the bounds below.
  const int runs = 120;
  Found one_place;
  Found no_offset;
  Found measured;
  for (int run = 0; run < runs; ++run) {
    const std::vector<PoseSample> samples = oracle::WithCovariances(
        oracle::DrawEstimate(laps.truth, noise, random), noise);
    Pose relative = laps.Relative();
    relative.x += Normal(random, 0.2);
    relative.y += Normal(random, 0.2);
    relative.heading += Normal(random, 0.02);
    const auto add = [&](Found* sum,
                         const std::shared_ptr<const MeasuredLoop>& closure) {
      const Found found = FindAfter(laps, samples, closure);
      sum->score += found.score / runs;
      sum->squared_end_difference += found.squared_end_difference / runs;
    };
    add(&one_place, nullptr);
    add(&no_offset, Measured(laps, samples, {}));
    add(&measured, Measured(laps, samples, relative));
  }
  std::printf("log-odds %.2f %.2f %.2f, squared difference %.2f %.2f %.2f\n",
              one_place.score, no_offset.score, measured.score,
              one_place.squared_end_difference,
              no_offset.squared_end_difference,
              measured.squared_end_difference);
  EXPECT_GT(measured.score, one_place.score + 0.5);
  EXPECT_GT(measured.score, no_offset.score + 0.1);
  EXPECT_LT(measured.squared_end_difference, 3.0);
  EXPECT_LT(measured.squared_end_difference,
            no_offset.squared_end_difference - 0.1);
}

TEST(DriveMeasuredTest, AgreementOfTrueMeasurementsIsChiSquare) {
  const TwoLaps laps;
  const oracle::Noise noise;
  std::mt19937_64 random = SeededRandom();
  const int runs = 400;
  double sum = 0.0;
  int improbable = 0;
  for (int run = 0; run < runs; ++run) {
    const std::vector<PoseSample> samples = oracle::WithCovariances(
        oracle::DrawEstimate(laps.truth, noise, random), noise);
    Drive drive(DriveSettings{});
    drive.Append(samples, 1);
    Pose relative = laps.Relative();
    relative.x += Normal(random, 0.2);
    relative.y += Normal(random, 0.2);
    relative.heading += Normal(random, 0.02);
    const auto agreement = drive.AgreementOf(laps.query + 1, kMatched + 1,
                                             Measured(laps, samples, relative));
    ASSERT_TRUE(agreement);
    EXPECT_EQ(agreement->degrees_of_freedom, 3);
    EXPECT_EQ(agreement->inflation, 1.0);
    sum += agreement->squared_mahalanobis;
    if (agreement->p_value < 0.05) ++improbable;
  }
  // Its mean is 3, with a standard deviation of sqrt(6 / 400).
  EXPECT_NEAR(sum / runs, 3.0, 0.6);
  EXPECT_LT(improbable, 40);
  EXPECT_GT(improbable, 5);
}

TEST(DriveMeasuredTest, ClosuresOfOneNodeAgreeToo) {
  // Poses every metre, nodes every 2 m.
  const TwoLaps laps;
  const std::vector<PoseSample> samples =
      oracle::WithCovariances(laps.truth, {});
  Drive drive(DriveSettings{});
  drive.Append(samples, 1);
  MeasuredLoop loop;
  loop.query = {samples[1].pose, samples[1].covariance};
  loop.matched = {samples[0].pose, samples[0].covariance};
  loop.measurement.relative.x = 1.0;
  for (int k = 0; k < 4; ++k) loop.measurement.covariance(k, k) = 0.01;
  const auto measured = std::make_shared<const MeasuredLoop>(loop);
  const auto agreement = drive.AgreementOf(2, 1, measured);
  ASSERT_TRUE(agreement);
  EXPECT_LT(agreement->squared_mahalanobis, 1.0);
  drive.AddLoopClosure(2, 1, 2, measured);
  EXPECT_EQ(drive.consistency().confirmed, 0);
}

TEST(DriveMeasuredTest, AgreementCountsTheVehiclesInflation) {
  const TwoLaps laps;
  const oracle::Noise noise;
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = oracle::WithCovariances(
      oracle::DrawEstimate(laps.truth, noise, random), noise);
  DriveSettings settings;
  settings.search.use_belief = false;
  Drive drive(settings);
  drive.Append(samples, 1);
  const auto measured = Measured(laps, samples, {5.0, 5.0, 0.0, 0.3});
  const auto claimed =
      drive.AgreementOf(laps.query + 1, kMatched + 1, measured);
  settings.apply_inflation = true;
  EXPECT_TRUE(drive.ChangeSettings(settings, 2).ok());
  const auto inflated =
      drive.AgreementOf(laps.query + 1, kMatched + 1, measured);
  ASSERT_TRUE(claimed && inflated);
  EXPECT_EQ(inflated->inflation, drive.consistency().inflation);
  EXPECT_GT(inflated->inflation, 1.0);
  EXPECT_LT(inflated->squared_mahalanobis, claimed->squared_mahalanobis);
}

}  // namespace
}  // namespace revisit::core
