#include "client/evaluation/evaluation.h"

#include <cmath>

#include "client/evaluation/drawings.h"
#include "client/formats/angles.h"
#include "client/map/map_svg.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

// Nodes 10 m apart: 0 to 9 along x, then 10 to 19 along x again from the start,
// 5 m aside, then 20 to 29 back the way they came.
struct Course {
  std::vector<GraphNode> nodes;
  std::vector<PlanarPose> truth;
};

Course TwoLapsAndBack() {
  Course course;
  for (int i = 0; i < 30; ++i) {
    GraphNode node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 10.0 * i;
    course.nodes.push_back(node);
    const double x = i < 20 ? 10.0 * (i % 10) : 10.0 * (29 - i);
    course.truth.push_back({x, i < 10 ? 0.0 : 5.0, i < 20 ? 0.0 : kPi});
  }
  return course;
}

CheckAnswer Answer(
    std::int64_t query,
    const std::vector<std::pair<std::int64_t, v1::Verdict>>& found) {
  CheckAnswer answer;
  answer.query = query;
  for (const auto& [matched, verdict] : found) {
    CandidateAnswer candidate;
    candidate.matched = matched;
    candidate.verdict = verdict;
    answer.candidates.push_back(candidate);
  }
  return answer;
}

Judging EightExcluded() {
  Judging judging;
  judging.first_check_meters = 0.0;
  judging.excluded_nodes = 8;
  return judging;
}

TEST(EvaluationTest, InterpolatesTheTruthWithHeadingOnTheShorterArc) {
  std::vector<GraphNode> nodes(3);
  nodes[0].sequence = 1;
  nodes[0].fraction = 0.25;
  nodes[1].sequence = 2;
  nodes[1].fraction = 0.5;
  nodes[2].sequence = 3;
  const auto truth =
      TruthAtNodes(nodes, {{0, 0, 0.0}, {4, 8, kPi - 0.1}, {8, 8, -kPi + 0.3}});
  EXPECT_NEAR(truth[0].x, 1.0, 1e-12);
  EXPECT_NEAR(truth[0].y, 2.0, 1e-12);
  EXPECT_NEAR(truth[0].heading, 0.25 * (kPi - 0.1), 1e-12);
  // Across the seam, by 0.2.
  EXPECT_NEAR(truth[1].heading, -kPi + 0.1, 1e-12);
  EXPECT_NEAR(truth[2].x, 8.0, 1e-12);
}

TEST(EvaluationTest, CallsARevisitInTheSameDirectionATrueLoop) {
  const Course course = TwoLapsAndBack();
  const auto checks =
      Judge(course.nodes, course.truth,
            {Answer(9, {}), Answer(15, {}), Answer(25, {})}, EightExcluded());
  ASSERT_EQ(checks.size(), 3u);
  // Nodes 0 and 1 only, 80 m away.
  EXPECT_FALSE(checks[0].true_loop);
  EXPECT_TRUE(checks[1].true_loop);
  // The same road, but the other way.
  EXPECT_FALSE(checks[2].true_loop);
}

TEST(EvaluationTest, ExcludesTheRecentPath) {
  const Course course = TwoLapsAndBack();
  Judging judging = EightExcluded();
  // Node 15 lies over nodes 4, 5 and 6, within 10 m of 5 and, a little more, of
  // the others.
  judging.excluded_nodes = 10;
  EXPECT_TRUE(Judge(course.nodes, course.truth, {Answer(15, {})}, judging)[0]
                  .true_loop);
  judging.excluded_nodes = 11;
  EXPECT_FALSE(Judge(course.nodes, course.truth, {Answer(15, {})}, judging)[0]
                   .true_loop);
}

TEST(EvaluationTest, JudgesCandidatesByTheSameTest) {
  const Course course = TwoLapsAndBack();
  const auto checks = Judge(course.nodes, course.truth,
                            {Answer(15, {{2, v1::VERDICT_ACCEPTED},
                                         {5, v1::VERDICT_REJECTED_BY_GATE},
                                         // Near enough, but of the recent path.
                                         {15, v1::VERDICT_ACCEPTED}})},
                            EightExcluded());
  EXPECT_THAT(checks[0].correct, ElementsAre(false, true, false));
  EXPECT_TRUE(checks[0].accepted());
  EXPECT_FALSE(checks[0].top_correct());
}

TEST(EvaluationTest, LeavesOutEarlyChecks) {
  const Course course = TwoLapsAndBack();
  Judging judging = EightExcluded();
  judging.first_check_meters = 150.0;
  const auto checks =
      Judge(course.nodes, course.truth,
            {Answer(14, {}), Answer(15, {}), Answer(16, {})}, judging);
  ASSERT_EQ(checks.size(), 2u);
  EXPECT_EQ(checks[0].answer.query, 15);
}

TEST(EvaluationTest, CountsAsTheProtocolSays) {
  const Course course = TwoLapsAndBack();
  const auto checks = Judge(
      course.nodes, course.truth,
      {
          // Right and accepted.
          Answer(15, {{5, v1::VERDICT_ACCEPTED}, {1, v1::VERDICT_ACCEPTED}}),
          // Right, but the verdict says no.
          Answer(16, {{6, v1::VERDICT_REJECTED_BY_GATE}}),
          // Wrong and accepted; the second would be right.
          Answer(17, {{1, v1::VERDICT_ACCEPTED}, {7, v1::VERDICT_ACCEPTED}}),
          // Right only in sixth place.
          Answer(18, {{1, v1::VERDICT_REJECTED_BY_GATE},
                      {2, v1::VERDICT_REJECTED_BY_GATE},
                      {3, v1::VERDICT_REJECTED_BY_GATE},
                      {4, v1::VERDICT_ILL_CONDITIONED},
                      {5, v1::VERDICT_REJECTED_BY_GATE},
                      {8, v1::VERDICT_REJECTED_BY_GATE}}),
          // No loop, accepted all the same.
          Answer(25, {{3, v1::VERDICT_ACCEPTED}}),
          // No loop, no candidate.
          Answer(26, {}),
      },
      EightExcluded());
  const Tally tally = Count(checks);
  EXPECT_EQ(tally.checks, 6);
  EXPECT_EQ(tally.true_loops, 4);
  EXPECT_EQ(tally.accepted, 3);
  EXPECT_EQ(tally.accepted_correct, 1);
  EXPECT_EQ(tally.top1_correct, 2);
  EXPECT_EQ(tally.top5_correct, 3);
  EXPECT_EQ(tally.to_verify, 5);
  EXPECT_EQ(tally.loops_found, 2);
  EXPECT_NEAR(*tally.precision(), 1.0 / 3.0, 1e-12);
  EXPECT_NEAR(*tally.recall(), 0.25, 1e-12);
  EXPECT_NEAR(*tally.f1(), 2.0 / 7.0, 1e-12);
  EXPECT_NEAR(*tally.to_verify_per_loop(), 2.5, 1e-12);
}

TEST(EvaluationTest, CountsFirstCandidatesAgainstTrueLoopsWhateverTheVerdict) {
  const Course course = TwoLapsAndBack();
  const Tally tally = Count(Judge(
      course.nodes, course.truth,
      {Answer(15, {{5, v1::VERDICT_AMBIGUOUS}}),
       Answer(16, {{1, v1::VERDICT_ACCEPTED}, {6, v1::VERDICT_UNINFORMATIVE}}),
       Answer(17, {{1, v1::VERDICT_REJECTED_BY_SHAPE}}), Answer(18, {})},
      EightExcluded()));
  EXPECT_EQ(tally.true_loops, 4);
  EXPECT_EQ(*tally.top1(), 0.25);
  EXPECT_EQ(*tally.recall_at_5(), 0.5);
}

TEST(EvaluationTest, VerifierLooksAtAllOfTheIntervalInWhichThePlaceMayLie) {
  CandidateAnswer candidate;
  EXPECT_EQ(LooksAt(candidate), 1);
  candidate.meters_before = 16.0;
  candidate.meters_after = 4.0;
  EXPECT_EQ(LooksAt(candidate), 1);
  candidate.meters_after = 4.5;
  EXPECT_EQ(LooksAt(candidate), 2);
  candidate.meters_before = candidate.meters_after = 40.0;
  EXPECT_EQ(LooksAt(candidate), 4);

  const Course course = TwoLapsAndBack();
  std::vector<CheckAnswer> answers = {
      // The first two are accepted, and looked at four times and once.
      Answer(15, {{1, v1::VERDICT_ACCEPTED},
                  {5, v1::VERDICT_ACCEPTED},
                  {4, v1::VERDICT_REJECTED_BY_SHAPE}}),
      Answer(16, {{1, v1::VERDICT_ACCEPTED}})};
  answers[0].candidates[0].meters_before = 40.0;
  answers[0].candidates[0].meters_after = 40.0;
  Tally tally =
      Count(Judge(course.nodes, course.truth, answers, EightExcluded()));
  EXPECT_EQ(tally.looks, 6);
  // The first loop is seen twice.
  EXPECT_EQ(tally.loops_found, 1);
  EXPECT_EQ(tally.loops_seen, 1);
  EXPECT_EQ(*tally.looks_per_loop(), 6.0);
  tally.Add(Tally(tally));
  EXPECT_EQ(*tally.looks_per_loop(), 6.0);
}

TEST(EvaluationTest, IntervalHoldsThePlaceIfOneOfItsNodesIsThere) {
  const Course course = TwoLapsAndBack();
  std::vector<CheckAnswer> answers = {Answer(15, {{1, v1::VERDICT_ACCEPTED}}),
                                      Answer(15, {{1, v1::VERDICT_ACCEPTED}}),
                                      Answer(15, {{8, v1::VERDICT_ACCEPTED}}),
                                      Answer(25, {{3, v1::VERDICT_ACCEPTED}})};
  // Node 5 is the place.
  answers[0].candidates[0].meters_after = 20.0;
  answers[1].candidates[0].meters_after = 45.0;
  answers[2].candidates[0].meters_before = 35.0;
  answers[3].candidates[0].meters_before = 40.0;
  const auto checks =
      Judge(course.nodes, course.truth, answers, EightExcluded());
  EXPECT_THAT(checks[0].holds, ElementsAre(false));
  EXPECT_THAT(checks[1].holds, ElementsAre(true));
  EXPECT_THAT(checks[2].holds, ElementsAre(true));
  EXPECT_THAT(checks[3].holds, ElementsAre(false));
  const Tally tally = Count(checks);
  EXPECT_EQ(tally.accepted_correct, 0);
  EXPECT_EQ(tally.accepted_holding, 2);
  EXPECT_EQ(*tally.interval_precision(), 0.5);
  EXPECT_NEAR(*tally.interval_recall(), 2.0 / 3.0, 1e-12);
  EXPECT_EQ(tally.loops_found, 0);
  EXPECT_EQ(tally.loops_seen, 2);
}

TEST(EvaluationTest, CollectsWhatFirstCandidatesState) {
  const Course course = TwoLapsAndBack();
  std::vector<CheckAnswer> answers = {
      Answer(15, {{5, v1::VERDICT_ACCEPTED}, {1, v1::VERDICT_ACCEPTED}}),
      Answer(16, {{1, v1::VERDICT_ACCEPTED}}), Answer(17, {})};
  answers[0].candidates[0].probability = 0.8;
  answers[0].candidates[0].confidence = 0.8;
  answers[0].candidates[1].probability = 0.1;
  answers[1].candidates[0].confidence = 0.3;
  const Tally tally =
      Count(Judge(course.nodes, course.truth, answers, EightExcluded()));
  ASSERT_EQ(tally.confidences.size(), 2u);
  EXPECT_EQ(tally.confidences[0].score, 0.8);
  EXPECT_TRUE(tally.confidences[0].correct);
  EXPECT_EQ(tally.confidences[1].score, 0.3);
  EXPECT_FALSE(tally.confidences[1].correct);
  // The second states no probability.
  ASSERT_EQ(tally.probabilities.size(), 1u);
  EXPECT_NEAR(*tally.calibration_error(), 0.2, 1e-15);
  Tally both = tally;
  both.Add(tally);
  EXPECT_EQ(both.probabilities.size(), 2u);
  EXPECT_NEAR(*both.calibration_error(), 0.2, 1e-15);
}

TEST(EvaluationTest, SureRecallCountsWhatIsRightAndStatedAtNineTenths) {
  const Course course = TwoLapsAndBack();
  std::vector<CheckAnswer> answers = {
      Answer(15, {{5, v1::VERDICT_ACCEPTED}}),
      // This one is turned down, which does not matter, since it is sure and
      // right.
      Answer(16, {{6, v1::VERDICT_AMBIGUOUS}}),
      // The third is sure and wrong, the fourth is right and not sure.
      Answer(17, {{1, v1::VERDICT_ACCEPTED}}),
      Answer(18, {{8, v1::VERDICT_ACCEPTED}})};
  const double stated[] = {0.9, 0.95, 0.99, 0.89};
  for (std::size_t i = 0; i < answers.size(); ++i) {
    answers[i].candidates[0].probability = stated[i];
  }
  Tally tally =
      Count(Judge(course.nodes, course.truth, answers, EightExcluded()));
  EXPECT_EQ(tally.true_loops, 4);
  EXPECT_EQ(tally.sure_correct, 2);
  EXPECT_EQ(*tally.sure_recall(), 0.5);
  tally.Add(Tally(tally));
  EXPECT_EQ(tally.sure_correct, 4);
  EXPECT_EQ(*tally.sure_recall(), 0.5);
  // Where nothing is stated, nothing can be sure.
  for (CheckAnswer& answer : answers) answer.candidates[0].probability.reset();
  EXPECT_FALSE(
      Count(Judge(course.nodes, course.truth, answers, EightExcluded()))
          .sure_recall()
          .has_value());
}

TEST(EvaluationTest, ChecksCanCountFromTheFirstTrueLoopOn) {
  const Course course = TwoLapsAndBack();
  const std::vector<CheckAnswer> answers = {
      Answer(8, {{0, v1::VERDICT_ACCEPTED}}), Answer(15, {}), Answer(25, {}),
      Answer(16, {{6, v1::VERDICT_ACCEPTED}})};
  Judging judging = EightExcluded();
  const auto all = Judge(course.nodes, course.truth, answers, judging);
  ASSERT_EQ(all.size(), 4u);
  EXPECT_FALSE(all[0].true_loop);
  EXPECT_TRUE(all[1].true_loop);
  // Checks after the first true loop count whether they are loops or not.
  EXPECT_FALSE(all[2].true_loop);
  judging.only_revisited = true;
  const auto later = Judge(course.nodes, course.truth, answers, judging);
  ASSERT_EQ(later.size(), 3u);
  EXPECT_EQ(later[0].answer.query, 15);
  EXPECT_EQ(Count(later).accepted, 1);
  EXPECT_TRUE(Judge(course.nodes, course.truth, {answers[0]}, judging).empty());
}

TEST(EvaluationTest, JudgesOppositePassesWhereTheyAreSought) {
  const Course course = TwoLapsAndBack();
  // Node 25 goes back over nodes 4 and 14.
  CheckAnswer answer =
      Answer(25, {{14, v1::VERDICT_ACCEPTED}, {14, v1::VERDICT_ACCEPTED}});
  answer.candidates[0].opposite = true;
  Judging judging = EightExcluded();
  judging.direction = PassDirection::kOpposite;
  auto checks = Judge(course.nodes, course.truth, {answer}, judging);
  EXPECT_TRUE(checks[0].true_loop);
  EXPECT_THAT(checks[0].correct, ElementsAre(true, false));
  // Node 15 follows node 5 the same way.
  checks = Judge(course.nodes, course.truth, {Answer(15, {})}, judging);
  EXPECT_FALSE(checks[0].true_loop);
  judging.direction = PassDirection::kEither;
  checks = Judge(course.nodes, course.truth, {answer, Answer(15, {})}, judging);
  EXPECT_FALSE(checks.empty());
  for (const JudgedCheck& check : checks) EXPECT_TRUE(check.true_loop);
}

TEST(EvaluationTest, AnswersAreTheSameButForTheirTime) {
  const CheckAnswer answer = Answer(15, {{5, v1::VERDICT_ACCEPTED}});
  CheckAnswer other = answer;
  other.search_milliseconds = 3.0;
  EXPECT_TRUE(SameAnswer(answer, other));
  other.candidates[0].probability = 0.5;
  EXPECT_FALSE(SameAnswer(answer, other));
  other = answer;
  other.candidates[0].meters_after = 0.5;
  EXPECT_FALSE(SameAnswer(answer, other));
  other = answer;
  other.candidates[0].p_value = 1e-300;
  EXPECT_FALSE(SameAnswer(answer, other));
  other = answer;
  other.candidates[0].frame_state = v1::FRAME_STATE_PROVISIONAL;
  EXPECT_FALSE(SameAnswer(answer, other));
  other = answer;
  other.candidates.clear();
  EXPECT_FALSE(SameAnswer(answer, other));
}

TEST(EvaluationTest, HasNoRatioWhereThereIsNothingToDivideBy) {
  const Tally nothing;
  EXPECT_FALSE(nothing.precision().has_value());
  EXPECT_FALSE(nothing.recall().has_value());
  EXPECT_FALSE(nothing.f1().has_value());
  EXPECT_FALSE(nothing.looks_per_loop().has_value());
  EXPECT_FALSE(nothing.interval_precision().has_value());
  EXPECT_FALSE(nothing.interval_recall().has_value());
  EXPECT_FALSE(nothing.top1().has_value());
  EXPECT_FALSE(nothing.recall_at_5().has_value());
  EXPECT_FALSE(nothing.calibration_error().has_value());
  EXPECT_FALSE(nothing.positive_calibration_error().has_value());
  EXPECT_FALSE(nothing.sure_recall().has_value());
  EXPECT_FALSE(nothing.to_verify_per_loop().has_value());
  EXPECT_FALSE(nothing.poses_per_second().has_value());
  EXPECT_FALSE(nothing.search_percentile(50.0).has_value());
}

TEST(EvaluationTest, TakesNearestRankPercentilesOfTheWholeSet) {
  Tally first;
  first.search_milliseconds = {4.0, 1.0};
  first.timed_poses = 100;
  first.seconds = 1.0;
  Tally second;
  second.search_milliseconds = {3.0, 2.0};
  second.timed_poses = 200;
  second.seconds = 2.0;
  first.Add(second);
  EXPECT_EQ(*first.search_percentile(50.0), 2.0);
  EXPECT_EQ(*first.search_percentile(75.0), 3.0);
  EXPECT_EQ(*first.search_percentile(99.0), 4.0);
  EXPECT_EQ(*first.search_percentile(0.0), 1.0);
  EXPECT_EQ(*first.poses_per_second(), 100.0);
}

int Occurrences(const std::string& text, const std::string& part) {
  int count = 0;
  for (std::size_t at = text.find(part); at != std::string::npos;
       at = text.find(part, at + part.size())) {
    ++count;
  }
  return count;
}

TEST(MapSvgTest, DrawsLinksAndCirclesByOutcome) {
  Course course = TwoLapsAndBack();
  for (std::size_t i = 0; i < course.nodes.size(); ++i) {
    course.nodes[i].estimate = course.truth[i];
    course.nodes[i].xx = 9.0;
    course.nodes[i].yy = 4.0;
  }
  DriveResult result;
  result.drive = "a < b & c";
  result.nodes = course.nodes;
  result.truth_at_nodes = course.truth;
  result.checks =
      Judge(course.nodes, course.truth,
            {Answer(15, {{5, v1::VERDICT_ACCEPTED}}),
             Answer(16, {{6, v1::VERDICT_REJECTED_BY_GATE}}),
             Answer(17, {{1, v1::VERDICT_ACCEPTED}}), Answer(26, {})},
            EightExcluded());
  const std::string svg = DrawMap(JudgedMap(result, false));
  EXPECT_THAT(svg, HasSubstr(": a &lt; b &amp; c</title>"));
  // Four checks and the legend.
  EXPECT_EQ(Occurrences(svg, "<ellipse"), 5);
  // One wrong link and the legend's.
  EXPECT_EQ(Occurrences(svg, "stroke-dasharray"), 2);
  // One missed loop and the legend's.
  EXPECT_EQ(Occurrences(svg, "fill=\"#f5b800\""), 2);
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(svg, Not(HasSubstr("inf\"")));
}

TEST(MapSvgTest, EnlargesACrowdedPartInAFreeCorner) {
  // 4 km along a diagonal and back beside it: two corners stay free, of which
  // one is for the scale bar.
  DriveResult result;
  for (int i = 0; i < 4000; ++i) {
    const double along = i < 2000 ? i : 3999 - i;
    GraphNode node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * i;
    node.estimate = {1.4 * along, 1.4 * along + (i < 2000 ? 0.0 : 40.0),
                     i < 2000 ? kPi / 4.0 : -3.0 * kPi / 4.0};
    result.nodes.push_back(node);
    result.truth_at_nodes.push_back(node.estimate);
  }
  std::vector<CheckAnswer> answers;
  for (int i = 150; i < 4000; i += 25) {
    answers.push_back(
        Answer(i, i < 2100 ? std::vector<std::pair<std::int64_t, v1::Verdict>>()
                           : std::vector<std::pair<std::int64_t, v1::Verdict>>{
                                 {3999 - i, v1::VERDICT_ACCEPTED}}));
  }
  result.checks =
      Judge(result.nodes, result.truth_at_nodes, answers, EightExcluded());
  const std::string svg = DrawMap(JudgedMap(result, false));
  EXPECT_EQ(Occurrences(svg, "enlarged 3 times"), 1);
  EXPECT_EQ(Occurrences(svg, "<clipPath"), 2);
}

TEST(MapSvgTest, DrawsASingleNode) {
  DriveResult result;
  result.nodes.resize(1);
  result.nodes[0].sequence = 1;
  result.truth_at_nodes.resize(1);
  EXPECT_THAT(DrawMap(JudgedMap(result, false)), Not(HasSubstr("nan")));
}

// Two recordings of the course: nodes 0 to 9, and 10 to 29, which asks.
Judging SecondAsks() {
  Judging judging;
  judging.first_check_meters = 0.0;
  judging.first_asking_node = 10;
  return judging;
}

TEST(EvaluationTest, OnlyOtherRecordingsCountWhereARecordingAsks) {
  const Course course = TwoLapsAndBack();
  // Node 25 was passed by the asking recording too, at node 14.
  const auto checks = Judge(
      course.nodes, course.truth,
      {Answer(5, {{0, v1::VERDICT_ACCEPTED}}),
       Answer(13, {{12, v1::VERDICT_ACCEPTED}, {3, v1::VERDICT_ACCEPTED}}),
       Answer(25, {{14, v1::VERDICT_ACCEPTED}})},
      SecondAsks());
  ASSERT_EQ(checks.size(), 2u);
  EXPECT_EQ(checks[0].answer.query, 13);
  ASSERT_EQ(checks[0].answer.candidates.size(), 1u);
  EXPECT_EQ(checks[0].answer.candidates[0].matched, 3);
  EXPECT_TRUE(checks[0].true_loop);
  EXPECT_TRUE(checks[0].top_correct());
  EXPECT_TRUE(checks[1].answer.candidates.empty());
  EXPECT_NE(checks[1].answer.empty_reason, "");
  // It was passed the other way.
  EXPECT_FALSE(checks[1].true_loop);
}

TEST(EvaluationTest, ChecksOfARecordingBeginWithItsOwnWay) {
  const Course course = TwoLapsAndBack();
  Judging judging = SecondAsks();
  judging.first_check_meters = 50.0;
  const std::vector<CheckAnswer> answers = {Answer(14, {}), Answer(15, {}),
                                            Answer(16, {})};
  EXPECT_EQ(Judge(course.nodes, course.truth, answers, judging).size(), 2u);
  // Behind the check at which a verifier tied it to another.
  judging.counted_behind = 15;
  EXPECT_EQ(Judge(course.nodes, course.truth, answers, judging).size(), 1u);
  judging.counted_behind = 30;
  EXPECT_TRUE(Judge(course.nodes, course.truth, answers, judging).empty());
}

TEST(EvaluationTest, NewRoadsAreThoseThatNoOtherRecordingHasWithin40Meters) {
  Course course = TwoLapsAndBack();
  // 45 m beside the first lap, and 30 m beside it, which is no loop either.
  course.truth[15].y = 45.0;
  course.truth[16].y = 30.0;
  const auto checks = Judge(course.nodes, course.truth,
                            {Answer(15, {{3, v1::VERDICT_ACCEPTED}}),
                             Answer(16, {{3, v1::VERDICT_ACCEPTED}}),
                             // The same place, the other way.
                             Answer(25, {{3, v1::VERDICT_REJECTED_BY_SHAPE}})},
                            SecondAsks());
  ASSERT_EQ(checks.size(), 3u);
  EXPECT_TRUE(checks[0].new_road);
  EXPECT_FALSE(checks[1].new_road);
  EXPECT_TRUE(checks[2].new_road);
  Tally tally = Count(checks);
  EXPECT_EQ(tally.new_road_checks, 2);
  EXPECT_EQ(tally.new_road_accepted, 1);
  tally.Add(Count(checks));
  EXPECT_EQ(tally.new_road_checks, 4);
  EXPECT_EQ(tally.new_road_accepted, 2);
  // Nothing is told of them where there is one recording.
  EXPECT_EQ(Count(Judge(course.nodes, course.truth, {Answer(15, {})},
                        EightExcluded()))
                .new_road_checks,
            0);
}

}  // namespace
}  // namespace revisit::client
