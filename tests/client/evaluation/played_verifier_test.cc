#include "client/evaluation/played_verifier.h"

#include <cmath>
#include <vector>

#include "gtest/gtest.h"
#include "tests/random.h"

namespace revisit::client {
namespace {

using Word = PlayedVerifier::Word;

TEST(PlayedVerifierTest, WithoutErrorsSaysTheTruth) {
  PlayedVerifier verifier({}, "drive", 1);
  for (int i = 0; i < 1000; ++i) {
    EXPECT_EQ(verifier.Judge(true), Word::kConfirm);
    EXPECT_EQ(verifier.Judge(false), Word::kReject);
    EXPECT_FALSE(verifier.Measure({}, {}, true));
  }
}

TEST(PlayedVerifierTest, IsSilentAndWrongAsOftenAsItIsTold) {
  constexpr int kCandidates = 20000;
  for (const bool is_right : {true, false}) {
    VerifierErrors errors;
    errors.silent = 0.2;
    errors.wrong = 0.1;
    PlayedVerifier verifier(errors, "drive", 7);
    int silent = 0;
    int wrong = 0;
    for (int i = 0; i < kCandidates; ++i) {
      const Word word = verifier.Judge(is_right);
      silent += word == Word::kNothing;
      wrong += word == (is_right ? Word::kReject : Word::kConfirm);
    }
    EXPECT_NEAR(silent, 0.2 * kCandidates, 0.01 * kCandidates);
    // Only candidates of which something is said can be judged wrongly.
    EXPECT_NEAR(wrong, 0.1 * 0.8 * kCandidates, 0.01 * kCandidates);
  }
}

TEST(PlayedVerifierTest, OneShareDoesNotMoveWhomTheOtherConcerns) {
  VerifierErrors errors;
  errors.wrong = 0.3;
  PlayedVerifier talks(errors, "drive", 5);
  errors.silent = 0.5;
  PlayedVerifier often_silent(errors, "drive", 5);
  for (int i = 0; i < 1000; ++i) {
    const Word word = talks.Judge(true);
    const Word other = often_silent.Judge(true);
    if (other != Word::kNothing) {
      EXPECT_EQ(other, word);
    }
  }
}

TEST(PlayedVerifierTest, DrivesAndSeedsHaveErrorsOfTheirOwn) {
  VerifierErrors errors;
  errors.wrong = 0.5;
  const auto words = [&](const char* drive, std::uint64_t seed) {
    PlayedVerifier verifier(errors, drive, seed);
    std::vector<Word> said;
    for (int i = 0; i < 100; ++i) said.push_back(verifier.Judge(true));
    return said;
  };
  EXPECT_EQ(words("one", 1), words("one", 1));
  EXPECT_NE(words("one", 1), words("one", 2));
  EXPECT_NE(words("one", 1), words("two", 1));
}

TEST(PlayedVerifierTest, EachShareMayBeAll) {
  VerifierErrors errors;
  errors.wrong = 1.0;
  PlayedVerifier liar(errors, "drive", 1);
  errors.silent = 1.0;
  PlayedVerifier mute(errors, "drive", 1);
  for (int i = 0; i < 1000; ++i) {
    EXPECT_EQ(liar.Judge(true), Word::kReject);
    EXPECT_EQ(mute.Judge(true), Word::kNothing);
  }
}

TEST(PlayedVerifierTest, MeasuresTheTruthWithTheNoiseThatItStates) {
  std::mt19937_64 random = revisit::SeededRandom();
  VerifierErrors errors;
  errors.measured = MeasurementNoise{0.5, 0.02};
  PlayedVerifier verifier(errors, "drive", 3);
  double squared = 0.0;
  constexpr int kMeasurements = 4000;
  for (int i = 0; i < kMeasurements; ++i) {
    const auto any = [&] {
      return PlanarPose{revisit::Normal(random, 50.0),
                        revisit::Normal(random, 50.0),
                        revisit::Uniform(random, -3.1, 3.1)};
    };
    const PlanarPose query = any();
    const PlanarPose matched = any();
    const auto measured = verifier.Measure(query, matched, true);
    // p_m + R(h_m) (x, y) is the query again.
    const double c = std::cos(matched.heading);
    const double s = std::sin(matched.heading);
    const double x = matched.x + c * measured->x_meters() -
                     s * measured->y_meters() - query.x;
    const double y = matched.y + s * measured->x_meters() +
                     c * measured->y_meters() - query.y;
    const double turn = std::remainder(
        matched.heading + measured->heading_radians() - query.heading,
        2.0 * std::acos(-1.0));
    const auto& covariance = measured->covariance().values();
    ASSERT_EQ(covariance.size(), 6);
    squared += x * x / covariance[0] + y * y / covariance[3] +
               turn * turn / covariance[5];
  }
  // Chi-square with 3 degrees of freedom has the variance 6.
  EXPECT_NEAR(squared / kMeasurements, 3.0,
              4.0 * std::sqrt(6.0 / kMeasurements));
}

TEST(PlayedVerifierTest, AFalsePlaceIsMeasuredAsIfTheVehicleWereThere) {
  VerifierErrors errors;
  errors.measured = MeasurementNoise{0.01, 0.001};
  PlayedVerifier verifier(errors, "drive", 3);
  const auto measured = verifier.Measure({500.0, 0.0, 1.0}, {}, false);
  EXPECT_NEAR(measured->x_meters(), 0.0, 0.1);
  EXPECT_NEAR(measured->heading_radians(), 0.0, 0.01);
}

}  // namespace
}  // namespace revisit::client
