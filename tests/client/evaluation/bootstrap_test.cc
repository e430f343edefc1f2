#include "client/evaluation/bootstrap.h"

#include <cmath>
#include <random>

#include "gtest/gtest.h"
#include "tests/random.h"

namespace revisit::client {
namespace {

JudgedCheck MadeCheck(bool true_loop, bool accepted, bool correct,
                      double probability) {
  JudgedCheck check;
  check.true_loop = true_loop;
  CandidateAnswer candidate;
  candidate.verdict =
      accepted ? v1::VERDICT_ACCEPTED : v1::VERDICT_REJECTED_BY_SHAPE;
  candidate.probability = probability;
  check.answer.candidates.push_back(candidate);
  check.correct.push_back(correct);
  check.holds.push_back(correct);
  return check;
}

// True loops, each found with probability `recall`, or not, for so many checks
// in a row on average.
std::vector<JudgedCheck> MadeChecks(std::mt19937_64& random, int count,
                                    double recall, double run) {
  std::vector<JudgedCheck> checks;
  bool found = false;
  for (int i = 0; i < count; ++i) {
    if (i == 0 || revisit::Uniform(random, 0.0, 1.0) < 1.0 / run) {
      found = revisit::Uniform(random, 0.0, 1.0) < recall;
    }
    checks.push_back(MadeCheck(true, found, found, found ? 0.9 : 0.1));
  }
  return checks;
}

double WidthOf(const std::optional<Interval>& interval) {
  return interval->high - interval->low;
}

TEST(BootstrapTest, ChecksThatDependOnNothingVaryAsTheBinomialDoes) {
  std::mt19937_64 random = revisit::SeededRandom();
  const auto checks = MadeChecks(random, 2000, 0.8, 1.0);
  const FigureIntervals intervals = Bootstrap({{&checks}});
  const double recall = *Count(checks).recall();
  EXPECT_LT(intervals.recall->low, recall);
  EXPECT_GT(intervals.recall->high, recall);
  const double wanted =
      2.0 * 1.96 * std::sqrt(recall * (1.0 - recall) / 2000.0);
  EXPECT_NEAR(WidthOf(intervals.recall), wanted, 0.25 * wanted);
}

TEST(BootstrapTest, ChecksThatFailTogetherMakeTheIntervalWider) {
  std::mt19937_64 random = revisit::SeededRandom();
  const auto apart = MadeChecks(random, 2000, 0.8, 1.0);
  const auto together = MadeChecks(random, 2000, 0.8, 5.0);
  EXPECT_GT(WidthOf(Bootstrap({{&together}}).recall),
            1.7 * WidthOf(Bootstrap({{&apart}}).recall));
}

TEST(BootstrapTest, SeedsOfOneDriveAreNoFurtherEvidence) {
  std::mt19937_64 random = revisit::SeededRandom();
  const auto checks = MadeChecks(random, 1000, 0.8, 1.0);
  const double once = WidthOf(Bootstrap({{&checks}}).recall);
  EXPECT_EQ(WidthOf(Bootstrap({{&checks, &checks}}).recall), once);
  EXPECT_LT(WidthOf(Bootstrap({{&checks}, {&checks}}).recall), 0.85 * once);
}

TEST(BootstrapTest, HoldsTheTruthAboutAsOftenAsItSays) {
  std::mt19937_64 random = revisit::SeededRandom();
  constexpr int kTrials = 200;
  int held = 0;
  for (int trial = 0; trial < kTrials; ++trial) {
    const auto checks = MadeChecks(random, 400, 0.8, 3.0);
    const FigureIntervals intervals = Bootstrap({{&checks}});
    held += intervals.recall->low <= 0.8 && 0.8 <= intervals.recall->high;
  }
  // Blocks of ten checks see a little less than all that runs of three do.
  EXPECT_GE(held, 0.85 * kTrials);
  EXPECT_LT(held, kTrials);
}

TEST(BootstrapTest, EachFigureIsThatOfCount) {
  // Each block has the same: one of five is accepted and wrong, one not found.
  std::vector<JudgedCheck> checks;
  for (int i = 0; i < 50; ++i) {
    checks.push_back(MadeCheck(/*true_loop=*/i % 5 != 0, /*accepted=*/i % 5 < 4,
                               /*correct=*/i % 5 != 0 && i % 5 < 4, 0.9));
  }
  const Tally tally = Count(checks);
  const FigureIntervals intervals = Bootstrap({{&checks}});
  for (const auto& [interval, figure] :
       {std::pair(intervals.precision, tally.precision()),
        std::pair(intervals.recall, tally.recall()),
        std::pair(intervals.f1, tally.f1()),
        std::pair(intervals.positive_calibration_error,
                  tally.positive_calibration_error())}) {
    EXPECT_NEAR(interval->low, *figure, 1e-12);
    EXPECT_NEAR(interval->high, *figure, 1e-12);
  }
}

TEST(BootstrapTest, WhereAllAreRightTheNumberOfBlocksSaysHowSureThatIs) {
  std::vector<JudgedCheck> checks(100, MadeCheck(false, false, false, 0.05));
  // Three blocks of ten tell of it, whatever they hold.
  for (const std::size_t i : {3, 4, 5, 42, 43, 77}) {
    checks[i] = MadeCheck(true, true, true, 0.9);
  }
  const FigureIntervals right = Bootstrap({{&checks}});
  EXPECT_NEAR(right.precision->low, std::cbrt(0.025), 1e-12);
  EXPECT_EQ(right.precision->high, 1.0);
  EXPECT_NEAR(right.recall->low, std::cbrt(0.025), 1e-12);
  EXPECT_EQ(right.f1->low, right.precision->low);
  // Seeds of one drive tell of the same road.
  EXPECT_EQ(Bootstrap({{&checks, &checks}}).recall->low, right.recall->low);
  for (JudgedCheck& check : checks) check.correct[0] = false;
  const FigureIntervals wrong = Bootstrap({{&checks}});
  EXPECT_EQ(wrong.precision->low, 0.0);
  EXPECT_NEAR(wrong.precision->high, 1.0 - std::cbrt(0.025), 1e-12);
}

TEST(BootstrapTest, WhatIsNotDefinedHasNoInterval) {
  const FigureIntervals none = Bootstrap({});
  EXPECT_FALSE(none.precision);
  EXPECT_FALSE(none.recall);
  // Two checks of forty are accepted: many draws are without them.
  std::vector<JudgedCheck> checks(40, MadeCheck(true, false, false, 0.2));
  checks[7] = MadeCheck(true, true, true, 0.9);
  checks[8] = MadeCheck(true, true, false, 0.9);
  const FigureIntervals rare = Bootstrap({{&checks}});
  EXPECT_FALSE(rare.precision);
  EXPECT_TRUE(rare.recall);
  EXPECT_TRUE(rare.positive_calibration_error);
}

}  // namespace
}  // namespace revisit::client
