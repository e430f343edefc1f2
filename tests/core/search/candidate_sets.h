// Compares answers of searches to the last bit.
#ifndef REVISIT_TESTS_CORE_SEARCH_CANDIDATE_SETS_H_
#define REVISIT_TESTS_CORE_SEARCH_CANDIDATE_SETS_H_

#include <gtest/gtest.h>

#include <cstddef>

#include "core/search/candidates/candidate.h"

namespace revisit::core {

inline void ExpectSameCandidate(const Candidate& a, const Candidate& b) {
  EXPECT_EQ(a.drive, b.drive);
  EXPECT_EQ(a.matched, b.matched);
  EXPECT_EQ(a.frame_state, b.frame_state);
  EXPECT_EQ(a.score, b.score);
  EXPECT_EQ(a.verdict, b.verdict);
  EXPECT_EQ(a.inflation, b.inflation);
  EXPECT_EQ(a.path, b.path);
  ASSERT_EQ(a.difference.has_value(), b.difference.has_value());
  if (a.difference) {
    EXPECT_EQ(a.difference->covariance.upper, b.difference->covariance.upper);
    EXPECT_EQ(a.difference->gate.squared_mahalanobis,
              b.difference->gate.squared_mahalanobis);
  }
  ASSERT_EQ(a.relative.has_value(), b.relative.has_value());
  if (!a.relative) return;
  EXPECT_EQ(a.relative->probability, b.relative->probability);
  EXPECT_EQ(a.relative->log_likelihood_ratio, b.relative->log_likelihood_ratio);
  EXPECT_EQ(a.relative->meters_before, b.relative->meters_before);
  EXPECT_EQ(a.relative->meters_after, b.relative->meters_after);
}

// All that answers say, but for how much was looked at.
inline void ExpectSameAnswers(const CandidateSet& a, const CandidateSet& b) {
  EXPECT_EQ(a.empty_reason, b.empty_reason);
  EXPECT_EQ(a.new_place_probability, b.new_place_probability);
  ASSERT_EQ(a.scale.has_value(), b.scale.has_value());
  if (a.scale) {
    EXPECT_EQ(a.scale->scale, b.scale->scale);
    EXPECT_EQ(a.scale->low, b.scale->low);
    EXPECT_EQ(a.scale->high, b.scale->high);
  }
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  for (std::size_t k = 0; k < a.candidates.size(); ++k) {
    ExpectSameCandidate(a.candidates[k], b.candidates[k]);
  }
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_SEARCH_CANDIDATE_SETS_H_
