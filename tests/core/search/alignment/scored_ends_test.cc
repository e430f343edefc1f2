#include "core/search/alignment/scored_ends.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>

#include "core/search/alignment/log_similarity.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

TEST(ScoredEndsTest, LeavesOutWhatIsImpossible) {
  const ScoredEnds ends =
      PossibleEnds({1.0, kImpossible, -2.0, kImpossible, kImpossible});
  ASSERT_EQ(ends.size(), 2u);
  EXPECT_EQ(ends[0].node, 0);
  EXPECT_EQ(ends[0].score, 1.0);
  EXPECT_EQ(ends[1].node, 2);
  EXPECT_EQ(ends[1].score, -2.0);
}

TEST(ScoredEndsTest, FindsTheEndsAroundANode) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 500; ++trial) {
    ScoredEnds ends;
    for (NodeIndex i = 0; i < 60; ++i) {
      if (UniformInt(random, 0, 2) == 0) ends.push_back({i, 0.0});
    }
    const NodeIndex centre = UniformInt(random, 0, 70);
    const int reach = UniformInt(random, 0, 40);
    // The centre itself may or may not count.
    const auto near = [&](NodeIndex i) { return std::abs(i - centre) < reach; };
    const EndsAround around = FindEndsAround(ends, centre, near);
    EXPECT_LE(around.first, around.later);
    EXPECT_LE(around.later, around.last);
    for (std::size_t k = 0; k < ends.size(); ++k) {
      EXPECT_EQ(around.first <= k && k < around.last, near(ends[k].node));
      EXPECT_EQ(around.later <= k, ends[k].node > centre);
    }
  }
}

}  // namespace
}  // namespace revisit::core
