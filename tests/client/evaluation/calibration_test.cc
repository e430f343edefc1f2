#include "client/evaluation/calibration.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

TEST(CalibrationTest, CurveGoesFromTheSurestDownAndTakesTiesTogether) {
  // By hand: at 0.9 one of one is right, at 0.5 two of three (two tie), at 0.1
  // two of four; four loops are true.
  const auto curve = PrecisionRecallCurve(
      {{0.1, false}, {0.5, true}, {0.9, true}, {0.5, false}}, 4);
  ASSERT_EQ(curve.size(), 3u);
  EXPECT_EQ(curve[0].threshold, 0.9);
  EXPECT_EQ(curve[0].precision, 1.0);
  EXPECT_EQ(curve[0].recall, 0.25);
  EXPECT_EQ(curve[1].threshold, 0.5);
  EXPECT_NEAR(curve[1].precision, 2.0 / 3.0, 1e-15);
  EXPECT_EQ(curve[1].recall, 0.5);
  EXPECT_EQ(curve[2].threshold, 0.1);
  EXPECT_EQ(curve[2].precision, 0.5);
  EXPECT_EQ(curve[2].recall, 0.5);
}

TEST(CalibrationTest, HasNoCurveWithoutTrueLoopsOrCandidates) {
  EXPECT_TRUE(PrecisionRecallCurve({{0.5, false}}, 0).empty());
  EXPECT_TRUE(PrecisionRecallCurve({}, 3).empty());
}

TEST(CalibrationTest, SortsStatementsIntoTenBins) {
  const auto bins = Reliability({{0.0, false},
                                 {0.05, true},
                                 {0.1, false},
                                 {0.95, true},
                                 {1.0, true},
                                 {0.999, false}});
  EXPECT_EQ(bins[0].low, 0.0);
  EXPECT_NEAR(bins[9].high, 1.0, 1e-15);
  // 0.1 begins the second bin; 1 belongs to the last.
  EXPECT_EQ(bins[0].count, 2);
  EXPECT_NEAR(bins[0].mean_stated, 0.025, 1e-15);
  EXPECT_EQ(bins[0].share_correct, 0.5);
  EXPECT_EQ(bins[1].count, 1);
  EXPECT_EQ(bins[1].share_correct, 0.0);
  for (std::size_t i = 2; i < 9; ++i) EXPECT_EQ(bins[i].count, 0) << i;
  EXPECT_EQ(bins[9].count, 3);
  EXPECT_NEAR(bins[9].mean_stated, (0.95 + 1.0 + 0.999) / 3.0, 1e-15);
  EXPECT_NEAR(bins[9].share_correct, 2.0 / 3.0, 1e-15);
}

TEST(CalibrationTest, WeighsBinsByTheirCounts) {
  // Three of four stated at 0.9 are right, off by 0.15; the one stated at 0.2
  // is not, off by 0.2: (4 * 0.15 + 1 * 0.2) / 5.
  EXPECT_NEAR(
      *ExpectedCalibrationError(
          {{0.9, true}, {0.9, true}, {0.9, false}, {0.9, true}, {0.2, false}}),
      0.16, 1e-15);
}

TEST(CalibrationTest, ErrorOfWhatIsStatedAtATenthIsNotDilutedByZeros) {
  // The five of the test above stand beside 95 that are rightly stated at 0.
  std::vector<Scored> stated = {
      {0.9, true}, {0.9, true}, {0.9, false}, {0.9, true}, {0.2, false}};
  stated.resize(100, {0.0, false});
  EXPECT_NEAR(*ExpectedCalibrationError(stated), 0.008, 1e-15);
  EXPECT_NEAR(*PositiveCalibrationError(stated), 0.16, 1e-15);
  // One at 0.1 counts, one below does not.
  EXPECT_NEAR(*PositiveCalibrationError({{0.1, false}, {0.09, true}}), 0.1,
              1e-15);
  EXPECT_FALSE(PositiveCalibrationError({{0.09, true}}).has_value());
  EXPECT_FALSE(PositiveCalibrationError({}).has_value());
}

TEST(CalibrationTest, FindsNothingWrongWithHonestStatements) {
  std::vector<Scored> stated;
  for (int i = 0; i < 10; ++i) stated.push_back({0.9, i < 9});
  for (int i = 0; i < 10; ++i) stated.push_back({0.3, i < 3});
  EXPECT_NEAR(*ExpectedCalibrationError(stated), 0.0, 1e-15);
  EXPECT_FALSE(ExpectedCalibrationError({}).has_value());
}

}  // namespace
}  // namespace revisit::client
