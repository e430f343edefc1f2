#include "core/search/alignment/far_histories.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <random>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/frame_relation.h"
#include "core/drive/joined_drives.h"
#include "core/search/alignment/relative.h"
#include "core/search/other_drives.h"
#include "core/search/search_scope.h"
#include "tests/core/drive/scoped_drives.h"
#include "tests/core/drive/wandering.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// One or two recordings, each placed somewhere in the world.
template <int D>
Drive Wandering(std::mt19937_64& random, const DriveSettings& settings,
                double world) {
  Drive drive(settings);
  for (int k = UniformInt(random, 1, 2); k > 0; --k) {
    std::vector<PoseSample> samples =
        WanderingSamples<D>(random, UniformInt(random, 40, 700));
    for (PoseSample& sample : samples) {
      sample.sequence += drive.last_sequence();
    }
    samples.front().recording_start =
        DatumAt({Uniform(random, -world, world), Uniform(random, -world, world),
                 0.0, Uniform(random, -3.0, 3.0)},
                std::exp(Uniform(random, -1.0, 4.0)),
                std::exp(Uniform(random, -8.0, -2.0)));
    drive.Append(samples, samples.back().sequence);
  }
  return drive;
}

struct Seen {
  std::int64_t far = 0;
  std::int64_t searched = 0;
  std::int64_t near = 0;
};

template <int D>
RelativeModel AnyModel(std::mt19937_64& random, const Drive& drive) {
  RelativeModel model;
  model.similarity = drive.SimilarityOf(drive.settings().search);
  model.opposite_direction = UniformInt(random, 0, 1) == 1;
  model.least_log_share = Uniform(random, -40.0, 0.0);
  if (UniformInt(random, 0, 1)) model.most_log_odds_sampled = -4.6;
  const int scales = UniformInt(random, 0, 3);
  for (int k = 0; k < scales; ++k) {
    model.scales.push_back({std::exp(Uniform(random, -1.0, 1.0)),
                            std::log(Uniform(random, 0.1, 1.0) / scales)});
  }
  return model;
}

// What is passed over as one has nothing that a search of it would find.
template <int D>
void ExpectNothingInFarOnes(std::mt19937_64& random, CorrelationModel noise,
                            Seen* seen) {
  DriveSettings settings;
  settings.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  settings.search.correlation_model = noise;
  const double world = std::exp(Uniform(random, 4.0, 11.0));
  std::vector<Drive> drives;
  std::vector<const Drive*> pointers;
  for (int d = 0; d < 5; ++d) {
    drives.push_back(Wandering<D>(random, settings, world));
  }
  for (const Drive& drive : drives) pointers.push_back(&drive);
  std::vector<FrameLink> links;
  for (int i = UniformInt(random, -1, 2); i > 0; --i) {
    const auto node_of = [&](const Drive& drive) {
      return static_cast<NodeIndex>(
          UniformInt(random, 0, static_cast<int>(drive.graph().size()) - 1));
    };
    links.push_back({0, 1, {node_of(drives[0]), node_of(drives[1]), nullptr}});
  }
  const SearchScope scope{Join(pointers, links), 0};
  const Drive& drive = drives[0];
  const NodeIndex node = drive.graph().size() - 1;
  const SeenFrames frames = scope.drives->SeenFrom(
      drive.frame_nodes(), drive.recordings(), node, {}, scope.asking);
  const std::size_t asking = frames.own + drive.recordings().size() - 1;
  const OtherDrives others(settings, settings.search, scope);
  GrowthOfOthers growth;
  std::vector<History> histories;
  others.AddHistories(frames.relations, frames.relations.From(asking),
                      {asking, drive.frame_nodes(), drive.recordings(), node},
                      &growth, &histories);
  const Query query{
      drive.graph(), node,
      UniformInt(random, 1,
                 static_cast<int>(node) + 1 -
                     static_cast<int>(drive.graph().SegmentStart(node))),
      &drive.motion_history(), &others.motion()};
  const RelativeModel model = AnyModel<D>(random, drive);
  AlignmentParts path;
  FarHistories far(query, model, &path);
  for (const History& history : histories) {
    const auto found = AlignRelative(query, history, model, nullptr);
    ASSERT_TRUE(found);
    const bool has_none = found->considered() == 0 &&
                          found->ends(Direction::kSame).empty() &&
                          found->ends(Direction::kOpposite).empty();
    if (far.Has(history)) {
      EXPECT_TRUE(has_none);
      ++seen->far;
    } else {
      ++(has_none ? seen->searched : seen->near);
    }
  }
}

TEST(FarHistoriesTest, NothingIsFoundInThoseThatArePassedOver) {
  std::mt19937_64 random = SeededRandom();
  Seen seen;
  for (int trial = 0; trial < 25; ++trial) {
    SCOPED_TRACE(trial);
    for (const CorrelationModel noise :
         {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
          CorrelationModel::kCorrelatedFixes}) {
      ExpectNothingInFarOnes<3>(random, noise, &seen);
      ExpectNothingInFarOnes<4>(random, noise, &seen);
    }
  }
  EXPECT_GT(seen.far, 60);
  EXPECT_GT(seen.near, 60);
  // Not much more is searched than need be.
  EXPECT_LT(seen.searched, seen.far + seen.near);
}

}  // namespace
}  // namespace revisit::core
