// Searches that sample improbable ends, held against those that look at each.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/drive.h"
#include "core/drive/motion_history.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/search/alignment/heading_match.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative.h"
#include "core/search/belief/mark.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/bench/roads.h"
#include "tests/core/drive/drives.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr NodeIndex kNodes = 12000;
constexpr std::int64_t kSteps = 150;
constexpr double kMostSampled = -4.6;

const PoseGraph& Roads() { return bench::Roads(kNodes); }

// A drive by dead reckoning, and a search of it.
struct TownSearch {
  TownSearch()
      : history(StateSpace::kPlanar, CorrelationModel::kDeadReckoning,
                StretchNodes(ShapeModel(), bench::kSpacing, kSteps)),
        bounds(StateSpace::kPlanar) {
    history.Extend(Roads());
    bounds.Extend(Roads());
    model.spacing_meters = bench::kSpacing;
    model.same_direction = model.opposite_direction = true;
    model.over_loops = false;
  }

  Query QueryAt(NodeIndex node) const {
    return {Roads(), node, kSteps, &history};
  }
  History PastOf(const Query& query) const {
    return {Roads(), query.node - query.steps + 1,
            {},      &history.heading_bins(),
            &bounds, {}};
  }

  RelativeAlignment Align(NodeIndex query, bool sampled) const {
    RelativeModel asked = model;
    asked.least_log_share = std::log(1e-6 / static_cast<double>(query));
    if (sampled) asked.most_log_odds_sampled = kMostSampled;
    return *AlignRelative(QueryAt(query), PastOf(QueryAt(query)), asked,
                          nullptr);
  }

  MotionHistory history;
  BlockBounds bounds;
  RelativeModel model;
};

std::vector<NodeIndex> Queries(NodeIndex apart = 613) {
  std::vector<NodeIndex> queries;
  for (NodeIndex query = 500; query < kNodes; query += apart) {
    queries.push_back(query);
  }
  return queries;
}

// Claims as they are, and such as make drift as wide as the town.
std::vector<std::vector<WeighedScale>> Claims() {
  return {{},
          {{4.0, std::log(0.3)}, {8.0, std::log(0.4)}, {16.0, std::log(0.3)}}};
}

TEST(SampledEndsTest, WhatMayBeProbableIsFoundToTheLastBit) {
  TownSearch search;
  std::size_t probable = 0;
  std::size_t of_all = 0;
  std::size_t of_sampled = 0;
  for (const std::vector<WeighedScale>& scales : Claims()) {
    search.model.scales = scales;
    for (const NodeIndex query : Queries()) {
      const RelativeAlignment all = search.Align(query, false);
      const RelativeAlignment sampled = search.Align(query, true);
      double greatest = 0.0;
      for (const Direction way : {Direction::kSame, Direction::kOpposite}) {
        for (const ScoredEnd& end : all.ends(way)) {
          greatest = std::max(greatest, end.score);
        }
      }
      const double surely = std::max(kMostSampled, greatest - 7.0) + 1e-6;
      for (const Direction way : {Direction::kSame, Direction::kOpposite}) {
        const ScoredEnds& ends = sampled.ends(way);
        of_all += all.ends(way).size();
        of_sampled += ends.size();
        for (const ScoredEnd& end : all.ends(way)) {
          if (!(end.score >= surely)) continue;
          ++probable;
          const auto found = std::find_if(
              ends.begin(), ends.end(),
              [&end](const ScoredEnd& e) { return e.node == end.node; });
          ASSERT_NE(found, ends.end()) << query << " " << end.node;
          EXPECT_EQ(found->score, end.score);
          EXPECT_EQ(sampled.match(way, end.node).steps,
                    all.match(way, end.node).steps);
        }
      }
    }
  }
  std::cout << probable << " probable ends; of " << of_all << " ends, "
            << of_sampled << " were looked at\n";
  EXPECT_GT(probable, 1000u);
  EXPECT_LT(3 * of_sampled, of_all);
}

TEST(SampledEndsTest, SamplesStandForTheOddsOfAllOthers) {
  TownSearch search;
  double most_apart = 0.0;
  search.model.scales = Claims().back();
  for (const NodeIndex query : Queries()) {
    std::array<double, 2> odds = {};
    for (const bool sampled : {false, true}) {
      const RelativeAlignment alignment = search.Align(query, sampled);
      for (const Direction way : {Direction::kSame, Direction::kOpposite}) {
        for (const ScoredEnd& end : alignment.ends(way)) {
          odds[sampled ? 1 : 0] += end.nodes * std::exp(end.score);
        }
      }
    }
    const double apart =
        std::abs(1.0 / (1.0 + odds[0]) - 1.0 / (1.0 + odds[1]));
    most_apart = std::max(most_apart, apart);
    EXPECT_LT(apart, 0.01) << query;
  }
  std::cout << "probability of a new place off by at most " << most_apart
            << "\n";
}

// How many nodes a path is off by slips, at most.
NodeIndex Slipped(const std::vector<PathStep>& path) {
  NodeIndex most = 0;
  for (const PathStep& step : path) {
    most =
        std::max(most, std::abs(std::abs(step.node - path[0].node) - step.t));
  }
  return most;
}

TEST(HeadingMatchTest, NoPathGainsMoreUnlessItSlipsMore) {
  TownSearch search;
  std::size_t slipped = 0;
  std::size_t paths = 0;
  double to_spare = 0.0;
  double to_spare_closely = 0.0;
  double least_to_spare = 100.0;
  for (const NodeIndex query : Queries(251)) {
    const Query asked = search.QueryAt(query);
    const RecentPath<3> recent(asked, search.model);
    const History past = search.PastOf(asked);
    const auto match = HeadingMatch::Make<3>(asked, past, recent);
    ASSERT_TRUE(match);
    const auto all = AlignRelative(asked, past, search.model, nullptr);
    for (const Direction way : {Direction::kSame, Direction::kOpposite}) {
      BlockRatios most;
      BlockRatios closely;
      for (const ScoredEnd& end : all->ends(way)) {
        const auto node = static_cast<std::size_t>(end.node);
        if (node % NodeBlock::kSize == 0) {
          match->Bound(node / NodeBlock::kSize, way, &most);
          match->Bound(node / NodeBlock::kSize, way, 0.0F, &closely);
        }
        const double ratio = all->match(way, end.node).log_likelihood_ratio;
        const double bound = closely[node % NodeBlock::kSize];
        ++paths;
        to_spare += most[node % NodeBlock::kSize] - ratio;
        to_spare_closely += bound - ratio;
        least_to_spare = std::min(least_to_spare, bound - ratio);
        EXPECT_LE(bound, most[node % NodeBlock::kSize]);
        if (ratio <= bound) continue;
        ++slipped;
        EXPECT_GT(Slipped(all->Path(way, end.node)), kMostSlips)
            << query << " " << end.node;
      }
    }
  }
  std::cout << paths << " paths, " << slipped << " of which slipped; "
            << to_spare / static_cast<double>(paths) << " nats to spare, "
            << to_spare_closely / static_cast<double>(paths)
            << " closely, at least " << least_to_spare << "\n";
  EXPECT_GT(paths, 100000u);
  EXPECT_LT(1000 * slipped, paths);
  EXPECT_LT(to_spare_closely, 0.9 * to_spare);
}

TEST(HeadingMatchTest, BoundsDoNotDependOnThoseAskedForBefore) {
  TownSearch search;
  const Query asked = search.QueryAt(kNodes - 1);
  const RecentPath<3> recent(asked, search.model);
  const History past = search.PastOf(asked);
  const auto match = HeadingMatch::Make<3>(asked, past, recent);
  ASSERT_TRUE(match);
  std::size_t lowered = 0;
  for (std::size_t block = 0; block < 20; ++block) {
    BlockRatios most;
    match->Bound(block, Direction::kSame, &most);
    for (const float enough : {20.0F, 5.0F, 10.0F, -1.0F, 40.0F}) {
      BlockRatios found;
      match->Bound(block, Direction::kSame, enough, &found);
      BlockRatios wanted;
      HeadingMatch::Make<3>(asked, past, recent)
          ->Bound(block, Direction::kSame, enough, &wanted);
      EXPECT_EQ(found, wanted) << block << " " << enough;
      for (std::size_t i = 0; i < found.size(); ++i) {
        lowered += found[i] < most[i] ? 1 : 0;
        EXPECT_GE(found[i], std::min(most[i], enough));
      }
    }
  }
  EXPECT_GT(lowered, 100u);
}

TEST(HeadingMatchTest, ShortPathsTellNothing) {
  const TownSearch search;
  Query asked = search.QueryAt(1000);
  const History past = search.PastOf(asked);
  asked.steps = 5;
  const RecentPath<3> recent(asked, search.model);
  EXPECT_FALSE(HeadingMatch::Make<3>(asked, past, recent));
}

TEST(SampledEndsTest, VerdictsAreThoseOfExhaustiveSearches) {
  DriveSettings settings;
  Drive drive(settings);
  Search search(&drive);
  SearchOptions exhaustive = settings.search;
  exhaustive.exhaustive = true;
  std::size_t checks = 0;
  for (NodeIndex i = 0; i < 6000; ++i) {
    const Node node = Roads().node(i);
    PoseSample sample;
    sample.sequence = static_cast<std::uint64_t>(i) + 1;
    sample.pose = node.pose;
    sample.covariance = node.covariance;
    const AppendResult result = drive.Append({sample}, sample.sequence);
    for (const NodeIndex query : result.checks_due) {
      const auto found = search.At(query, settings.search, nullptr);
      const auto wanted = search.At(query, exhaustive, nullptr);
      ASSERT_TRUE(found.ok() && wanted.ok());
      EXPECT_NEAR(found->new_place_probability.value_or(1.0),
                  wanted->new_place_probability.value_or(1.0), 0.01);
      ++checks;
      if (found->candidates.empty()) continue;
      const Candidate& best = found->candidates.front();
      const Candidate& exact = wanted->candidates.front();
      EXPECT_NEAR(best.relative->probability, exact.relative->probability,
                  0.01);
      if (exact.relative->probability < 0.05) continue;
      EXPECT_EQ(best.matched, exact.matched);
      EXPECT_EQ(best.verdict, exact.verdict);
    }
  }
  EXPECT_GT(checks, 100u);
}

// A road, a jump to another one, and then a stretch of the first road again
// that ends close to the jump: in the same frame after another jump, or in a
// recording of its own.
std::vector<PoseSample> DriveWithJump(std::mt19937_64& random,
                                      bool in_one_recording) {
  const oracle::Noise noise;
  const auto estimate = [&](const std::vector<Pose>& truth) {
    return oracle::WithCovariances(oracle::DrawEstimate(truth, noise, random),
                                   noise);
  };
  Trip first(Pose{0.0, 0.0, 0.0, Uniform(random, -3.0, 3.0)});
  const int meters = UniformInt(random, 260, 560);
  const double phase = Uniform(random, 0.0, 1000.0);
  first.Winding(phase, phase + meters);
  const std::size_t jump = first.poses().size();
  first.JumpTo({Uniform(random, 300.0, 600.0), Uniform(random, 300.0, 600.0),
                0.0, Uniform(random, -3.0, 3.0)});
  const double elsewhere = Uniform(random, 2000.0, 3000.0);
  first.Winding(elsewhere, elsewhere + UniformInt(random, 520, 700));
  const std::size_t end =
      jump - 1 - static_cast<std::size_t>(UniformInt(random, 0, 30));
  std::vector<Pose> again(
      first.poses().begin() + static_cast<std::ptrdiff_t>(end) - 220,
      first.poses().begin() + static_cast<std::ptrdiff_t>(end) + 1);
  if (in_one_recording) {
    std::vector<Pose> all = first.poses();
    all.insert(all.end(), again.begin(), again.end());
    return estimate(all);
  }
  std::vector<PoseSample> samples = estimate(first.poses());
  RecordingStart start;
  start.relation = RecordingRelation::kDatum;
  start.covariance(0, 0) = start.covariance(1, 1) = 4.0;
  start.covariance(2, 2) = 1.0;
  start.covariance(3, 3) = 1e-4;
  samples.front().recording_start =
      std::make_shared<const RecordingStart>(start);
  start.datum = again.front();
  for (Pose& pose : again) pose = Compose(Inverse(start.datum), pose);
  std::vector<PoseSample> of_pass = estimate(again);
  of_pass.front().recording_start =
      std::make_shared<const RecordingStart>(start);
  for (PoseSample& sample : of_pass) {
    sample.sequence = samples.size() + 1;
    samples.push_back(sample);
  }
  return samples;
}

// A sample beyond a jump says nothing of the nodes before it.
TEST(SampledEndsTest, PlacesNextToAJumpAreFound) {
  std::mt19937_64 random = SeededRandom();
  DriveSettings settings;
  SearchOptions exhaustive = settings.search;
  exhaustive.exhaustive = true;
  int seen_before = 0;
  int missed = 0;
  for (int trial = 0; trial < 2000; ++trial) {
    Drive drive(settings);
    drive.Append(DriveWithJump(random, trial % 2 == 0), 1);
    Search search(&drive);
    const auto found = search.AtEnd(settings.search, nullptr);
    const auto wanted = search.AtEnd(exhaustive, nullptr);
    ASSERT_TRUE(found.ok() && wanted.ok());
    if (wanted->candidates.empty() ||
        wanted->candidates.front().relative->probability < 0.05) {
      continue;
    }
    ++seen_before;
    const Candidate& exact = wanted->candidates.front();
    if (found->candidates.empty() ||
        found->candidates.front().matched != exact.matched) {
      ++missed;
      continue;
    }
    EXPECT_NEAR(found->candidates.front().relative->probability,
                exact.relative->probability, 0.01)
        << trial;
  }
  std::cout << seen_before << " places seen before, " << missed << " missed\n";
  EXPECT_GT(seen_before, 1500);
  EXPECT_EQ(missed, 0);
}

}  // namespace
}  // namespace revisit::core
