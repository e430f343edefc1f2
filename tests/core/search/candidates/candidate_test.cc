#include "core/search/candidates/candidate.h"

#include <gtest/gtest.h>

namespace revisit::core {
namespace {

std::vector<Candidate> WithScores(const std::vector<double>& scores) {
  std::vector<Candidate> candidates;
  for (const double score : scores) {
    Candidate candidate;
    candidate.score = score;
    candidate.matched = static_cast<NodeIndex>(candidates.size());
    candidates.push_back(candidate);
  }
  return candidates;
}

TEST(CandidateTest, TheBestAreKeptAndEqualsKeepTheirOrder) {
  std::vector<Candidate> candidates = WithScores({-3.0, 1.0, -2.0, 1.0});
  KeepBest(3, &candidates);
  ASSERT_EQ(candidates.size(), 3u);
  EXPECT_EQ(candidates[0].matched, 1);
  EXPECT_EQ(candidates[1].matched, 3);
  EXPECT_EQ(candidates[2].matched, 2);
}

TEST(CandidateTest, FewerThanAskedForAreAllKept) {
  std::vector<Candidate> candidates = WithScores({-3.0, 1.0});
  KeepBest(5, &candidates);
  EXPECT_EQ(candidates.size(), 2u);
}

}  // namespace
}  // namespace revisit::core
