#include "client/evaluation/baselines.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

// Nodes 2 m apart: 100 along x, then back beside them at this distance.
std::vector<GraphNode> OutAndBack(double aside) {
  std::vector<GraphNode> nodes;
  for (int i = 0; i < 200; ++i) {
    GraphNode node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * i;
    node.estimate.x = 2.0 * (i < 100 ? i : 199 - i);
    node.estimate.y = i < 100 ? 0.0 : aside;
    nodes.push_back(node);
  }
  return nodes;
}

std::vector<std::int64_t> Matched(const CheckAnswer& answer) {
  std::vector<std::int64_t> matched;
  for (const CandidateAnswer& candidate : answer.candidates) {
    matched.push_back(candidate.matched);
  }
  return matched;
}

TEST(BaselinesTest, NearestPositionsComeFirstAndKeepApart) {
  NearestPosition options;
  options.excluded_nodes = 75;
  // Node 169 lies 5 m from node 30, at x = 60; 14.1 m reach 7 nodes to each
  // side, and 10 m along the path are 5 nodes.
  const auto answers = FindNearestPositions(OutAndBack(5.0), {169}, options);
  ASSERT_EQ(answers.size(), 1u);
  EXPECT_EQ(answers[0].query, 169);
  EXPECT_THAT(Matched(answers[0]), ElementsAre(30, 25, 35));
  EXPECT_EQ(answers[0].candidates[0].verdict, v1::VERDICT_ACCEPTED);
  EXPECT_NEAR(answers[0].candidates[0].confidence, -5.0, 1e-12);
  EXPECT_FALSE(answers[0].candidates[0].probability.has_value());
  EXPECT_FALSE(answers[0].search_milliseconds.has_value());
}

TEST(BaselinesTest, NearestPositionsLeaveOutTheRecentPathAndWhatIsFar) {
  NearestPosition options;
  options.excluded_nodes = 75;
  // All that node 110 has within reach is younger than 75 nodes.
  auto answers = FindNearestPositions(OutAndBack(5.0), {110, 169}, options);
  EXPECT_THAT(Matched(answers[0]), IsEmpty());
  EXPECT_EQ(answers[0].empty_reason, "no node of the history is near");
  EXPECT_THAT(
      Matched(FindNearestPositions(OutAndBack(15.5), {169}, options)[0]),
      IsEmpty());
  options.max_candidates = 1;
  answers = FindNearestPositions(OutAndBack(5.0), {169}, options);
  EXPECT_THAT(Matched(answers[0]), ElementsAre(30));
}

TEST(BaselinesTest, LeavesOutTheRecentPathButKeepsTheOrder) {
  CheckAnswer answer;
  answer.query = 200;
  for (const std::int64_t matched : {190, 40, 126, 125, 7}) {
    CandidateAnswer candidate;
    candidate.matched = matched;
    answer.candidates.push_back(candidate);
  }
  CheckAnswer all = answer;
  LeaveOutRecentPath(75, 5, &all);
  EXPECT_THAT(Matched(all), ElementsAre(40, 125, 7));
  LeaveOutRecentPath(75, 2, &all);
  EXPECT_THAT(Matched(all), ElementsAre(40, 125));
  LeaveOutRecentPath(200, 2, &all);
  EXPECT_THAT(Matched(all), IsEmpty());
  EXPECT_EQ(all.empty_reason, "all candidates lie on the recent path");
}

}  // namespace
}  // namespace revisit::client
