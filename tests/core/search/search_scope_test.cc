// Searches over the drives of several vehicles.
#include "core/search/search_scope.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <thread>
#include <utility>
#include <vector>

#include "core/drive/block_growth.h"
#include "core/drive/drive.h"
#include "core/drive/drive_view.h"
#include "core/drive/joined_drives.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/search/other_drives.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/core/drive/scoped_drives.h"
#include "tests/core/search/candidate_sets.h"

namespace revisit::core {
namespace {

using Datums = std::vector<std::shared_ptr<const RecordingStart>>;

// The ring is driven on, a recording after the other, with some metres between
// that nobody drove.
std::vector<Pose> PartOfRing(const std::vector<int>& ends, std::size_t k) {
  const std::vector<Pose> ring = Ring(static_cast<double>(ends.back()));
  return {ring.begin() + (k == 0 ? 0 : ends[k - 1] + 20),
          ring.begin() + ends[k]};
}

Datums ThreeDatums() {
  return {DatumAt({10.0, 20.0, 0.0, 0.3}, 3.0, 0.02, "site"),
          DatumAt({-30.0, 5.0, 0.0, -1.0}, 5.0, 0.03),
          DatumAt({4.0, 7.0, 0.0, 2.0}, 3.0, 0.02, "site")};
}

// So wide that no node is surely elsewhere, by which drives would weigh shapes
// (chance.h).
Datums WideDatums() {
  return {DatumAt({10.0, 20.0, 0.0, 0.3}, 300.0, 0.02),
          DatumAt({-30.0, 5.0, 0.0, -1.0}, 500.0, 0.03),
          DatumAt({4.0, 7.0, 0.0, 2.0}, 400.0, 0.02)};
}

// The same recordings as those of one drive, and as drives of their own.
struct OneAndMany {
  OneAndMany(const DriveSettings& settings, const std::vector<int>& ends,
             const Datums& datums)
      : one(settings) {
    for (std::size_t k = 0; k < ends.size(); ++k) {
      const std::vector<Pose> part = PartOfRing(ends, k);
      first.push_back(one.graph().size());
      one.Append(RecordingOf(part, datums[k], one.last_sequence()), k + 1);
      many.emplace_back(settings);
      many.back().Append(RecordingOf(part, datums[k], 0), 1);
    }
  }

  std::shared_ptr<const JoinedDrives> Joined(
      std::vector<FrameLink> links = {}) const {
    std::vector<const Drive*> drives;
    for (const Drive& drive : many) drives.push_back(&drive);
    return Join(drives, std::move(links));
  }

  Drive one;
  std::vector<Drive> many;
  // The first node of each recording of `one`.
  std::vector<NodeIndex> first;
};

CandidateSet Answer(Search* search, NodeIndex query,
                    const SearchOptions& options,
                    const SearchScope* scope = nullptr) {
  const auto set = scope == nullptr
                       ? search->At(query, options, nullptr)
                       : search->At(query, options, *scope, nullptr);
  EXPECT_TRUE(set.ok());
  return *set;
}

CandidateSet Answer(const Drive& drive, NodeIndex query,
                    const SearchOptions& options,
                    const SearchScope* scope = nullptr) {
  Search search(&drive);
  return Answer(&search, query, options, scope);
}

NodeIndex LastOf(const Drive& drive) { return drive.graph().size() - 1; }

void ExpectSameBits(const CandidateSet& a, const CandidateSet& b) {
  EXPECT_EQ(a.nodes_considered, b.nodes_considered);
  EXPECT_EQ(a.nodes_pruned, b.nodes_pruned);
  EXPECT_EQ(a.comparisons, b.comparisons);
  ExpectSameAnswers(a, b);
}

TEST(SearchScopeTest, RejectedPlacesOfAnotherDriveAreNotOffered) {
  DriveSettings settings;
  const OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const Drive& asking = drives.many[2];
  const SearchScope scope{drives.Joined(), 2, true};
  const NodeIndex query = LastOf(asking);
  const CandidateSet before = Answer(asking, query, settings.search, &scope);
  ASSERT_FALSE(before.candidates.empty());
  const Candidate best = before.candidates[0];
  const DriveView& other = scope.drives->view(*best.drive);
  const auto rejecting = [&](FrameLink pair) {
    std::vector<JoinedDrive> joined;
    for (const Drive& drive : drives.many) joined.push_back({drive.View(1.0)});
    return SearchScope{
        std::make_shared<const JoinedDrives>(joined, std::vector<FrameLink>(),
                                             std::vector<FrameLink>{pair}),
        2, true};
  };
  const auto offers = [&](const SearchScope& in) {
    const CandidateSet found = Answer(asking, query, settings.search, &in);
    return std::any_of(found.candidates.begin(), found.candidates.end(),
                       [&](const Candidate& candidate) {
                         return candidate.drive == best.drive &&
                                other.graph.MetersApart(candidate.matched,
                                                        best.matched) <=
                                    kPlaceRadiusMeters;
                       });
  };
  EXPECT_TRUE(offers(scope));
  EXPECT_FALSE(
      offers(rejecting({2, *best.drive, {query, best.matched, nullptr}})));
  EXPECT_FALSE(
      offers(rejecting({*best.drive, 2, {best.matched, query, nullptr}})));
  EXPECT_TRUE(
      offers(rejecting({2, *best.drive, {query - 50, best.matched, nullptr}})));
}

// Numbers differ in their last digits, since distances along the path count
// from another beginning, and the motion of all is added up in another order.
TEST(SearchScopeTest, DrivesAreSearchedAsTheRecordingsOfOneDriveAre) {
  DriveSettings settings;
  settings.search.use_belief = false;
  settings.search.exhaustive = true;
  for (const CorrelationModel model :
       {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent}) {
    settings.search.correlation_model = model;
    const OneAndMany drives(settings, {1300, 2600, 4300}, WideDatums());
    const SearchScope scope{drives.Joined(), 2};
    for (NodeIndex query = 120; query < drives.many[2].graph().size();
         query += 119) {
      SCOPED_TRACE(query);
      const CandidateSet one =
          Answer(drives.one, drives.first[2] + query, settings.search);
      const CandidateSet many =
          Answer(drives.many[2], query, settings.search, &scope);
      EXPECT_EQ(many.comparisons, one.comparisons);
      EXPECT_EQ(many.nodes_considered, one.nodes_considered);
      EXPECT_NEAR(*many.new_place_probability, *one.new_place_probability,
                  1e-9);
      ASSERT_EQ(many.candidates.size(), one.candidates.size());
      ASSERT_FALSE(one.candidates.empty());
      for (std::size_t i = 0; i < one.candidates.size(); ++i) {
        const Candidate& x = one.candidates[i];
        const Candidate& y = many.candidates[i];
        EXPECT_EQ(x.matched, drives.first[y.drive.value_or(2)] + y.matched);
        EXPECT_EQ(x.frame_state, y.frame_state);
        EXPECT_EQ(x.verdict, y.verdict);
        EXPECT_EQ(x.path.size(), y.path.size());
        EXPECT_NEAR(x.score, y.score, 1e-9 * (1.0 + std::abs(x.score)));
        EXPECT_NEAR(x.relative->probability, y.relative->probability, 1e-9);
        ASSERT_EQ(x.difference.has_value(), y.difference.has_value());
        EXPECT_NEAR(x.difference->gate.squared_mahalanobis,
                    y.difference->gate.squared_mahalanobis,
                    1e-9 * (1.0 + x.difference->gate.squared_mahalanobis));
      }
    }
  }
}

// Blocks of nodes begin elsewhere, so other nodes are pruned and sampled.
TEST(SearchScopeTest, PruningFindsWhatIsProbable) {
  DriveSettings settings;
  settings.search.use_belief = false;
  const OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const SearchScope scope{drives.Joined(), 2};
  SearchOptions exhaustive = settings.search;
  exhaustive.exhaustive = true;
  NodeIndex pruned = 0;
  for (NodeIndex query = 120; query < drives.many[2].graph().size();
       query += 61) {
    const CandidateSet all = Answer(drives.many[2], query, exhaustive, &scope);
    const CandidateSet some =
        Answer(drives.many[2], query, settings.search, &scope);
    pruned += some.nodes_pruned;
    EXPECT_NEAR(*all.new_place_probability, *some.new_place_probability, 2e-6);
    ASSERT_FALSE(some.candidates.empty());
    EXPECT_EQ(all.candidates[0].matched, some.candidates[0].matched);
    EXPECT_EQ(all.candidates[0].drive, some.candidates[0].drive);
    EXPECT_NEAR(all.candidates[0].relative->probability,
                some.candidates[0].relative->probability, 2e-6);
  }
  EXPECT_GT(pruned, 0);
}

TEST(SearchScopeTest, OneNewPlaceStandsAgainstAllHistories) {
  const DriveSettings settings;
  const OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const NodeIndex query = LastOf(drives.many[2]);
  const SearchScope scope{drives.Joined(), 2};
  const CandidateSet set =
      Answer(drives.many[2], query, settings.search, &scope);
  double claimed = *set.new_place_probability;
  std::vector<bool> found(3);
  for (const Candidate& candidate : set.candidates) {
    found[candidate.drive.value_or(2)] = true;
    claimed = std::max(claimed, candidate.relative->probability);
  }
  EXPECT_EQ(found, std::vector<bool>({true, true, true}));
  EXPECT_LE(claimed, 1.0);
  // Passes of one place speak for each other, whichever vehicles drove them.
  const CandidateSet alone = Answer(drives.many[2], query, settings.search);
  EXPECT_LT(*set.new_place_probability, *alone.new_place_probability);
  // Other drives say nothing of the scale of this one.
  EXPECT_EQ(set.scale->scale, alone.scale->scale);
}

TEST(SearchScopeTest, AnswersAreTheSameFromTheStartAndAfterOtherSearches) {
  const DriveSettings settings;
  const OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const SearchScope scope{drives.Joined({{2, 0, {300, 20, nullptr}}}), 2};
  const SearchScope another{drives.Joined(), 2};
  Search kept(&drives.many[2]);
  for (NodeIndex query = 200; query < drives.many[2].graph().size();
       query += 75) {
    SCOPED_TRACE(query);
    const CandidateSet again = Answer(&kept, query, settings.search, &scope);
    ExpectSameBits(again,
                   Answer(drives.many[2], query, settings.search, &scope));
    Answer(&kept, query, settings.search, &another);
    // Nor does a scope change what comes after it without one.
    ExpectSameBits(Answer(&kept, query, settings.search),
                   Answer(drives.many[2], query, settings.search));
  }
}

TEST(SearchScopeTest, AScopeWithoutOtherDrivesIsNone) {
  const DriveSettings settings;
  const OneAndMany drives(settings, {2600}, {ThreeDatums()[0]});
  const Drive& drive = drives.many[0];
  const Drive empty(settings);
  for (const SearchScope& scope :
       {SearchScope{Join({})}, SearchScope{Join({&drive}), 0},
        SearchScope{Join({&empty, &drive}), 1}}) {
    for (NodeIndex query = 50; query < drive.graph().size(); query += 150) {
      ExpectSameBits(Answer(drive, query, settings.search, &scope),
                     Answer(drive, query, settings.search));
    }
  }
}

TEST(SearchScopeTest, WithoutItsOwnHistoryADriveFindsOthersAlone) {
  const DriveSettings settings;
  const OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const SearchScope with{drives.Joined(), 2};
  SearchScope without = with;
  without.exclude_own = true;
  const Drive& drive = drives.many[2];
  const NodeIndex others =
      drives.many[0].graph().size() + drives.many[1].graph().size();
  const NodeIndex query = LastOf(drive);
  const CandidateSet own = Answer(drive, query, settings.search, &with);
  const auto is_own = [](const Candidate& candidate) {
    return !candidate.drive.has_value();
  };
  EXPECT_TRUE(
      std::any_of(own.candidates.begin(), own.candidates.end(), is_own));
  const CandidateSet set = Answer(drive, query, settings.search, &without);
  ASSERT_FALSE(set.candidates.empty());
  EXPECT_TRUE(
      std::none_of(set.candidates.begin(), set.candidates.end(), is_own));
  EXPECT_EQ(set.nodes_considered + set.nodes_pruned, others);
  EXPECT_LT(set.comparisons, own.comparisons);
  // There is nothing where there is nobody else, and others' history where
  // there is no own.
  const SearchScope alone{Join({}), std::nullopt, true};
  EXPECT_EQ(Answer(drive, query, settings.search, &alone).empty_reason,
            EmptyReason::kNoHistory);
  const NodeIndex first = SequenceNodes(settings.search.sequence_length_meters,
                                        settings.node_spacing_meters) -
                          1;
  EXPECT_EQ(Answer(drive, first, settings.search).empty_reason,
            EmptyReason::kNoHistory);
  EXPECT_FALSE(Answer(drive, first, settings.search, &with).candidates.empty());
}

// Drives over one ring each, so far from each other along x.
struct Rings {
  Rings(const DriveSettings& settings, int count, double meters) {
    for (int k = 0; k < count; ++k) {
      std::vector<Pose> ring = Ring(1300.0);
      for (Pose& pose : ring) pose.x += meters * k;
      drives.emplace_back(settings);
      drives.back().Append(
          RecordingOf(ring, DatumAt({meters * k, 0.0, 0.0, 0.0}, 3.0, 0.02), 0),
          1);
      pointers.push_back(nullptr);
    }
    for (std::size_t k = 0; k < drives.size(); ++k) pointers[k] = &drives[k];
  }

  std::vector<Drive> drives;
  std::vector<const Drive*> pointers;
};

TEST(SearchScopeTest, DrivesThatAreFarAwayCountInNothingButTheirNodes) {
  DriveSettings settings;
  const Rings far(settings, 5, 20000.0);
  const Drive& drive = far.drives[2];
  const NodeIndex query = LastOf(drive);
  const SearchScope all{Join(far.pointers), 2};
  const CandidateSet alone = Answer(drive, query, settings.search);
  Search search(&drive);
  const CandidateSet set = Answer(&search, query, settings.search, &all);
  EXPECT_EQ(set.comparisons, alone.comparisons);
  EXPECT_EQ(search.last_comparisons(), set.comparisons);
  EXPECT_EQ(
      set.nodes_considered + set.nodes_pruned,
      alone.nodes_considered + alone.nodes_pruned + 4 * drive.graph().size());
  // Where all are looked at, all count.
  settings.search.exhaustive = true;
  EXPECT_GT(Answer(&search, query, settings.search, &all).comparisons,
            4 * alone.comparisons);
}

TEST(SearchScopeTest, NearDrivesAreRefusedBeyondTheMostComparisons) {
  DriveSettings settings;
  const Rings near(settings, 3, 1.0);
  const Drive& drive = near.drives[1];
  const NodeIndex query = LastOf(drive);
  const SearchScope all{Join(near.pointers), 1};
  Search search(&drive);
  const CandidateSet set = Answer(&search, query, settings.search, &all);
  EXPECT_GT(set.comparisons, Answer(drive, query, settings.search).comparisons);
  EXPECT_FALSE(set.candidates.empty());
  settings.search.max_comparisons = set.comparisons;
  EXPECT_FALSE(
      Answer(&search, query, settings.search, &all).candidates.empty());
  --settings.search.max_comparisons;
  const CandidateSet refused = Answer(&search, query, settings.search, &all);
  EXPECT_EQ(refused.empty_reason, EmptyReason::kTooMuchWork);
  EXPECT_EQ(refused.comparisons, set.comparisons);
  EXPECT_EQ(refused.nodes_considered + refused.nodes_pruned, 0);
  EXPECT_FALSE(refused.scale.has_value());
  EXPECT_EQ(search.last_comparisons(), 0);
  // What was about to be made is known of a search that is stopped too.
  settings.search.max_comparisons = set.comparisons;
  const auto stopped =
      search.At(query, settings.search, all, [] { return true; });
  EXPECT_FALSE(stopped.ok());
  EXPECT_EQ(search.last_comparisons(), set.comparisons);
}

TEST(SearchScopeTest, MotionThatIsPooledTellsTheSame) {
  DriveSettings settings;
  const Rings near(settings, 6, 3.0);
  const Drive& drive = near.drives[3];
  const NodeIndex query = LastOf(drive);
  const auto pooled = Join(near.pointers);
  ASSERT_NE(pooled->PoolFrom(0), nullptr);
  // All views are new ones.
  std::vector<JoinedDrive> views;
  for (const Drive* one : near.pointers) views.push_back({one->View(1.0)});
  const auto apart = std::make_shared<const JoinedDrives>(
      views, std::vector<FrameLink>(), std::vector<FrameLink>(), pooled.get());
  EXPECT_EQ(apart->PoolFrom(0), nullptr);
  const std::vector<bool> few = {false, true, false, true, false, false};
  const std::vector<bool> most = {true, true, false, true, true, true};
  for (const std::vector<bool>& searched : {std::vector<bool>(), few, most}) {
    const SearchScope with{pooled, 3, true, searched};
    const SearchScope without{apart, 3, true, searched};
    ExpectSameBits(Answer(drive, query, settings.search, &with),
                   Answer(drive, query, settings.search, &without));
    // Stretches of another length than those of the pool.
    SearchOptions options = settings.search;
    options.sequence_length_meters = 20.0;
    ExpectSameBits(Answer(drive, query, options, &with),
                   Answer(drive, query, options, &without));
  }
  // The same views again are pooled, and what is pooled is kept.
  const auto again = std::make_shared<const JoinedDrives>(
      views, std::vector<FrameLink>(), std::vector<FrameLink>(), apart.get());
  ASSERT_NE(again->PoolFrom(0), nullptr);
  const JoinedDrives kept(views, {}, {}, again.get());
  EXPECT_EQ(kept.PoolFrom(0), again->PoolFrom(0));
  // Not if one is gone.
  views.pop_back();
  EXPECT_NE(JoinedDrives(views, {}, {}, again.get()).PoolFrom(0),
            again->PoolFrom(0));
}

TEST(SearchScopeTest, ALinkSaysWhereAnotherDriveLies) {
  const DriveSettings settings;
  const Datums nowhere(2);
  const OneAndMany drives(settings, {1300, 2400}, nowhere);
  const Drive& drive = drives.many[1];
  const NodeIndex query = LastOf(drive);
  const auto best = [&](const std::vector<FrameLink>& links) {
    const SearchScope scope{drives.Joined(links), 1};
    const CandidateSet set = Answer(drive, query, settings.search, &scope);
    EXPECT_FALSE(set.candidates.empty());
    return set.candidates.front();
  };
  const Candidate untied = best({});
  EXPECT_EQ(untied.drive, 0u);
  EXPECT_EQ(untied.frame_state, FrameState::kNone);
  EXPECT_FALSE(untied.difference.has_value());
  // Both drives are in one frame, and so is the link true.
  const NodeIndex c = 100;
  NodeIndex m = 0;
  const Pose at = drive.graph().pose(c);
  const PoseGraph& graph = drives.many[0].graph();
  for (NodeIndex j = 0; j < graph.size(); ++j) {
    const auto meters = [&](NodeIndex i) {
      return std::hypot(graph.pose(i).x - at.x, graph.pose(i).y - at.y);
    };
    if (meters(j) < meters(m)) m = j;
  }
  const Candidate tied = best({{1, 0, {c, m, nullptr}}});
  EXPECT_EQ(tied.frame_state, FrameState::kProvisional);
  EXPECT_TRUE(tied.difference.has_value());
  EXPECT_GT(tied.score, untied.score);
  const Pose matched = graph.pose(tied.matched);
  const Pose asked = drive.graph().pose(query);
  EXPECT_LT(std::hypot(matched.x - asked.x, matched.y - asked.y), 10.0);
  // The other way round it says the same, but to first order.
  EXPECT_EQ(best({{0, 1, {m, c, nullptr}}}).matched, tied.matched);
}

TEST(SearchScopeTest, ADriveThatIsNotSearchedStillTiesFrames) {
  DriveSettings settings;
  settings.search.exhaustive = true;
  settings.search.max_candidates = 50;
  const OneAndMany drives(settings, {1300, 2400, 3500}, Datums(3));
  const Drive& drive = drives.many[2];
  // The first drive is tied to the last one only over the one between.
  const auto joined =
      drives.Joined({{1, 0, {40, 40, nullptr}}, {2, 1, {40, 40, nullptr}}});
  const SearchScope all{joined, 2};
  SearchScope first = all;
  first.searched = {true, false, false};
  const auto in_first = [&](const SearchScope& scope) {
    std::vector<std::pair<NodeIndex, double>> found;
    bool has_others = false;
    const CandidateSet set =
        Answer(drive, LastOf(drive), settings.search, &scope);
    EXPECT_TRUE(set.unsearched.empty());
    for (const Candidate& candidate : set.candidates) {
      if (candidate.drive == 1u) has_others = true;
      if (candidate.drive != 0u) continue;
      EXPECT_NE(candidate.frame_state, FrameState::kNone);
      found.emplace_back(candidate.matched, candidate.score);
    }
    EXPECT_EQ(has_others, scope.searched.empty());
    return found;
  };
  const auto found = in_first(first);
  const auto among_all = in_first(all);
  ASSERT_FALSE(found.empty());
  ASSERT_FALSE(among_all.empty());
  EXPECT_EQ(found.front().first, among_all.front().first);
  // But for the motion and the roads of the other, by which shapes are weighed.
  EXPECT_NEAR(found.front().second, among_all.front().second, 0.5);
}

// Where errors grow says which blocks may be left out unseen.
TEST(SearchScopeTest, GrowthIsThatOfEachViewAndIsForgottenWithIt) {
  const std::vector<Pose> ring = Ring(1300.0);
  Drive grows(DriveSettings{});
  grows.Append(RecordingOf(ring, nullptr, 0), 1);
  DriveSettings fixes;
  fixes.search.correlation_model = CorrelationModel::kIndependent;
  Drive does_not(fixes);
  does_not.Append(WithDeviations(ring, 1.0, 0.1), 1);
  const auto kept = does_not.View(1.0);
  const auto joining = [](std::vector<JoinedDrive> drives) {
    return std::make_shared<const JoinedDrives>(std::move(drives),
                                                std::vector<FrameLink>());
  };
  const auto joined = joining({{grows.View(1.0)}, {kept}});
  GrowthOfOthers growth;
  growth.Enter(joined);
  for (std::size_t d = 0; d < 2; ++d) {
    const DriveView& view = joined->view(d);
    for (const NodeIndex reference : {0, 200}) {
      const Growth& growth_of = growth.Of(d, 0, reference);
      const std::vector<char>& found = growth_of.blocks;
      EXPECT_EQ(found, BlocksGrowing(view.state_space, view.graph,
                                     {0, view.graph.size()}, reference));
      EXPECT_EQ(std::count(found.begin(), found.end(), 1) > 0, d == 0);
      EXPECT_EQ(growth_of.all_grow, d == 0);
    }
  }
  // Growth from the first node of a recording is found where it is joined.
  EXPECT_EQ(growth.size(), 3u);
  growth.Enter(joining({{kept}}));
  EXPECT_EQ(growth.size(), 2u);
}

TEST(SearchScopeTest, DrivesThatCannotBeComparedAreCounted) {
  const DriveSettings settings;
  DriveSettings spatial = settings;
  spatial.state_space = StateSpace::kSpatial;
  DriveSettings fixes = settings;
  fixes.search.correlation_model = CorrelationModel::kIndependent;
  DriveSettings coarse = settings;
  coarse.node_spacing_meters = 2.5;
  const auto datum = DatumAt({}, 3.0, 0.02);
  const std::vector<Pose> ring = Ring(2600.0);
  std::vector<Drive> drives;
  for (const DriveSettings& each :
       {settings, spatial, fixes, coarse, settings}) {
    drives.emplace_back(each);
    drives.back().Append(RecordingOf(ring, datum, 0), 1);
  }
  const SearchScope scope{
      Join({&drives[0], &drives[1], &drives[2], &drives[3], &drives[4]}), 4};
  const auto unsearched = [&](const SearchOptions& options) {
    const CandidateSet set =
        Answer(drives[4], LastOf(drives[4]), options, &scope);
    for (const Candidate& candidate : set.candidates) {
      EXPECT_EQ(candidate.drive.value_or(0), 0u);
    }
    return set.unsearched;
  };
  const auto expect = [](const std::vector<UnsearchedDrive>& found,
                         const std::vector<UnsearchedDrive>& wanted) {
    ASSERT_EQ(found.size(), wanted.size());
    for (std::size_t i = 0; i < found.size(); ++i) {
      EXPECT_EQ(found[i].drive, wanted[i].drive);
      EXPECT_EQ(found[i].reason, wanted[i].reason);
    }
  };
  expect(unsearched(settings.search), {{1, UnsearchedReason::kStateSpace},
                                       {2, UnsearchedReason::kNoiseModel},
                                       {3, UnsearchedReason::kNodeSpacing}});
  SearchOptions composite = settings.search;
  composite.alignment = AlignmentKind::kComposite;
  expect(unsearched(composite), {{0, UnsearchedReason::kAlignment},
                                 {1, UnsearchedReason::kAlignment},
                                 {2, UnsearchedReason::kAlignment},
                                 {3, UnsearchedReason::kAlignment}});
  EXPECT_TRUE(
      Answer(drives[4], LastOf(drives[4]), settings.search).unsearched.empty());
}

TEST(SearchScopeTest, SearchesMayShareAScopeAtATime) {
  const DriveSettings settings;
  const OneAndMany drives(settings, {1300, 2600, 3900}, ThreeDatums());
  const auto joined = drives.Joined({{1, 0, {300, 20, nullptr}}});
  const auto ask = [&](std::size_t d) {
    const SearchScope scope{joined, d};
    return Answer(drives.many[d], LastOf(drives.many[d]), settings.search,
                  &scope);
  };
  std::vector<CandidateSet> together(3);
  std::vector<std::thread> askers;
  for (std::size_t d = 0; d < 3; ++d) {
    askers.emplace_back([&, d] { together[d] = ask(d); });
  }
  for (std::thread& asker : askers) asker.join();
  for (std::size_t d = 0; d < 3; ++d) ExpectSameBits(together[d], ask(d));
}

TEST(SearchScopeTest, AViewAnswersAsTheDriveWasThen) {
  const DriveSettings settings;
  OneAndMany drives(settings, {1300, 2600, 4300}, ThreeDatums());
  const SearchScope scope{drives.Joined(), 2};
  const Drive& drive = drives.many[2];
  const NodeIndex query = LastOf(drive);
  const CandidateSet before = Answer(drive, query, settings.search, &scope);
  drives.many[0].Append(RecordingOf(PartOfRing({1300, 2600}, 1), nullptr,
                                    drives.many[0].last_sequence()),
                        2);
  ExpectSameBits(Answer(drive, query, settings.search, &scope), before);
  const SearchScope now{drives.Joined(), 2};
  EXPECT_GT(Answer(drive, query, settings.search, &now).comparisons,
            before.comparisons);
}

// Prior odds belong to a road, not to those who have driven it.
TEST(SearchScopeTest, ARoadIsAsProbableHoweverManyHaveDrivenIt) {
  const DriveSettings settings;
  Drive asking(settings);
  asking.Append(RecordingOf(Ring(700.0), DatumAt({}, 50.0, 0.02), 0), 1);
  Drive other(settings);
  other.Append(RecordingOf(Ring(700.0), DatumAt({}, 50.0, 0.02), 0), 1);
  const auto ask = [&](std::size_t passes) {
    std::vector<const Drive*> drives(passes, &other);
    drives.push_back(&asking);
    const SearchScope scope{Join(drives), passes, /*exclude_own=*/true};
    return Answer(asking, 300, settings.search, &scope);
  };
  const CandidateSet one = ask(1);
  ASSERT_FALSE(one.candidates.empty());
  for (const std::size_t passes : {4, 16, 64}) {
    SCOPED_TRACE(passes);
    const CandidateSet many = ask(passes);
    EXPECT_NEAR(*many.new_place_probability, *one.new_place_probability, 0.02);
    EXPECT_NEAR(many.candidates[0].relative->probability,
                one.candidates[0].relative->probability, 0.02);
  }
}

}  // namespace
}  // namespace revisit::core
