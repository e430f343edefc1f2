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
    options_.candidate_separation_meters = 60.0;
    drive_.Append(WithDeviations(Ring(4'000.0), 5.0, 0.1), 1);
    query_ = drive_.graph().size() - 1;
  }

  // Nodes [first, end) of the drive.
  History PastOf(NodeIndex first, NodeIndex end) const {
    History past{drive_.graph(), end};
    past.first = first;
    past.heading_bins = &drive_.motion_history().heading_bins();
    past.block_bounds = &drive_.block_bounds();
    return past;
  }

  CandidateSet Find(std::vector<History> histories) const {
    CandidateSet set;
    const Query query{drive_.graph(), query_, kSteps, &drive_.motion_history()};
    EXPECT_TRUE(SearchRelative(SearchTask{query,
                                          query,
                                          std::move(histories),
                                          0,
                                          nullptr,
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
  const NodeIndex half = all / 2;
  const std::vector<History> histories = {PastOf(0, half), PastOf(half, all)};
  const CandidateSet alone[] = {Find({histories[0]}), Find({histories[1]})};
  const CandidateSet both = Find(histories);

  double odds = 1.0;
  for (const CandidateSet& set : alone) {
    ASSERT_GT(set.candidates.size(), 1u);
    odds += 1.0 / *set.new_place_probability - 1.0;
  }
  // Passes of one place share its odds (Rivals::AverageOverPasses()), and no
  // place has more passes than there are places.
  EXPECT_GE(*both.new_place_probability * odds, 1.0 - 1e-9);
  const auto places = static_cast<double>(both.candidates.size());
  EXPECT_LE(*both.new_place_probability, 1.0 / (1.0 + (odds - 1.0) / places));
  EXPECT_EQ(both.nodes_considered, all);
  ASSERT_EQ(both.candidates.size(),
            alone[0].candidates.size() + alone[1].candidates.size());
  for (const Candidate& candidate : both.candidates) {
    const CandidateSet& set = alone[candidate.matched < half ? 0 : 1];
    const Candidate* const same = Among(set, candidate.matched);
    ASSERT_TRUE(same);
    EXPECT_EQ(candidate.score, same->score);
    EXPECT_EQ(candidate.path, same->path);
    EXPECT_EQ(candidate.relative->meters_before, same->relative->meters_before);
  }
}

}  // namespace
}  // namespace revisit::core
