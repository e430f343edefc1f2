#include "core/search/candidates/relative_search.h"

#include <gtest/gtest.h>

#include <optional>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"

namespace revisit::core {
namespace {

constexpr std::int64_t kSteps = 75;

// Searches at the end of a drive, in one history or more.
class RelativeSearchTest : public ::testing::Test {
 protected:
  RelativeSearchTest() : drive_(DriveSettings()) {
    options_.exhaustive = true;
    options_.max_candidates = 100;
    drive_.Append(WithDeviations(Ring(4'000.0), 5.0, 0.1), 1);
    query_ = drive_.graph().size() - 1;
  }

  // Nodes [0, size) of the drive.
  History PastOf(NodeIndex size) const {
    History past{drive_.graph(), size};
    past.heading_bins = &drive_.motion_history().heading_bins();
    past.block_bounds = &drive_.block_bounds();
    return past;
  }

  CandidateSet Find(std::vector<History> histories) const {
    CandidateSet set;
    EXPECT_TRUE(SearchRelative(SearchTask{{drive_.graph(), query_, kSteps,
                                           &drive_.motion_history()},
                                          std::move(histories),
                                          options_,
                                          drive_.settings().node_spacing_meters,
                                          {drive_.SimilarityOf(options_),
                                           std::nullopt, std::nullopt},
                                          nullptr},
                               &set)
                    .ok());
    return set;
  }

  Drive drive_;
  SearchOptions options_;
  NodeIndex query_ = 0;
};

const Candidate* Among(const CandidateSet& set, NodeIndex matched) {
  for (const Candidate& candidate : set.candidates) {
    if (candidate.matched == matched) return &candidate;
  }
  return nullptr;
}

TEST_F(RelativeSearchTest, OddsOfAllHistoriesAreAgainstTheSameNewPlace) {
  const NodeIndex all = query_ - kSteps + 1;
  const std::vector<History> histories = {PastOf(all), PastOf(all / 2)};
  const CandidateSet alone[] = {Find({histories[0]}), Find({histories[1]})};
  const CandidateSet both = Find(histories);

  double odds = 1.0;
  for (const CandidateSet& set : alone) {
    ASSERT_GT(set.candidates.size(), 1u);
    odds += 1.0 / *set.new_place_probability - 1.0;
  }
  EXPECT_NEAR(*both.new_place_probability * odds, 1.0, 1e-9);
  EXPECT_EQ(both.nodes_considered, all + all / 2);
  ASSERT_EQ(both.candidates.size(),
            alone[0].candidates.size() + alone[1].candidates.size());
  for (const Candidate& candidate : both.candidates) {
    const CandidateSet& set = alone[candidate.history];
    const Candidate* const same = Among(set, candidate.matched);
    ASSERT_TRUE(same);
    EXPECT_EQ(candidate.score, same->score);
    EXPECT_EQ(candidate.path, same->path);
    EXPECT_EQ(candidate.relative->meters_before, same->relative->meters_before);
    EXPECT_NEAR(candidate.relative->probability,
                same->relative->probability * *both.new_place_probability /
                    *set.new_place_probability,
                1e-9);
  }
}

TEST_F(RelativeSearchTest, OfEqualScoresTheFirstHistoryComesFirst) {
  const NodeIndex all = query_ - kSteps + 1;
  const CandidateSet set = Find({PastOf(all), PastOf(all)});
  ASSERT_GT(set.candidates.size(), 2u);
  for (std::size_t i = 0; i < set.candidates.size(); i += 2) {
    EXPECT_EQ(set.candidates[i].history, 0u);
    EXPECT_EQ(set.candidates[i + 1].history, 1u);
    EXPECT_EQ(set.candidates[i + 1].matched, set.candidates[i].matched);
  }
}

}  // namespace
}  // namespace revisit::core
