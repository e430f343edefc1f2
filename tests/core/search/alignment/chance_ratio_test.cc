#include "core/search/alignment/chance_ratio.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/drive_view.h"
#include "core/drive/frame_relation.h"
#include "core/geometry/pose.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/path_walk.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relation.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/shape_filter.h"
#include "core/settings.h"
#include "tests/core/drive/scoped_drives.h"

namespace revisit::core {
namespace {

// Poses each metre along blocks of these lengths, with a left turn of a right
// angle, 6 m of radius, after each.
std::vector<Pose> Blocks(const std::vector<double>& meters) {
  std::vector<Pose> poses;
  Pose pose;
  const auto drive = [&](double length, double curvature) {
    for (double s = 0.0; s < length; s += 1.0) {
      poses.push_back(pose);
      pose.heading += curvature;
      pose.x += std::cos(pose.heading);
      pose.y += std::sin(pose.heading);
    }
  };
  for (const double block : meters) {
    drive(block, 0.0);
    drive(9.0, 3.14159265358979 / 2.0 / 9.0);
  }
  return poses;
}

Drive Driven(const std::vector<Pose>& poses) {
  Drive drive((DriveSettings()));
  drive.Append(RecordingOf(poses, nullptr, 0), 1);
  return drive;
}

// Other drives around one that asks at its newest node.
class ChanceRatioTest : public testing::Test {
 protected:
  // The frame of each lies so many metres beside the asking one, with an error
  // of 10 m.
  void Add(const std::vector<Pose>& poses, double meters_beside) {
    views_.push_back(Driven(poses).View(1.0));
    FrameRelation tie;
    tie.state = FrameState::kProvisional;
    tie.transform.x = meters_beside;
    for (int i : {0, 1}) tie.fixed(i, i) = 100.0;
    tie.fixed(3, 3) = 1e-4;
    tie.asking_node = 0;
    tie.other_node = 0;
    ties_.push_back(tie);
  }

  std::vector<History> Histories() const {
    std::vector<History> histories;
    for (std::size_t k = 0; k < views_.size(); ++k) {
      const DriveView& view = *views_[k];
      histories.push_back(
          {view.graph,
           view.graph.size(),
           {},
           nullptr,
           nullptr,
           Relation(RelatedFrames(asking_.frame_nodes(), view.nodes()),
                    ties_[k], {})});
    }
    return histories;
  }

  Query AtEnd() const {
    const PoseGraph& graph = asking_.graph();
    return {graph, graph.size() - 1, steps_};
  }

  double Measure(AlignmentParts* parts = nullptr) const {
    return LogChanceRatio(AtEnd(), Histories(), model_, parts);
  }

  // Turns are rare on the vehicle's own roads, but for the last ones.
  std::int64_t steps_ = 150;
  const Drive asking_ = Driven(Blocks({2000.0, 90.0, 90.0, 90.0, 40.0}));
  std::vector<std::shared_ptr<const DriveView>> views_;
  std::vector<FrameRelation> ties_;
  RelativeModel model_;
};

TEST_F(ChanceRatioTest, NothingIsMeasuredWhereTheVehicleMayBe) {
  EXPECT_EQ(Measure(), 0.0);
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 2000.0);
  ties_[0].fixed(0, 0) = ties_[0].fixed(1, 1) = 1e4;
  EXPECT_EQ(Measure(), 0.0);
}

TEST_F(ChanceRatioTest, RoadsThatAreAlikeElsewhereCount) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  const double alike = Measure();
  EXPECT_GT(alike, 1.0);
  views_.clear();
  ties_.clear();
  Add(Blocks({2000.0}), 6000.0);
  EXPECT_LT(Measure(), 0.5 * alike);
}

TEST_F(ChanceRatioTest, FramesThatNothingTiesTellNothing) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  ties_[0].state = FrameState::kNone;
  EXPECT_EQ(Measure(), 0.0);
}

// One road that is just the same adds no more than its share of the nodes.
TEST_F(ChanceRatioTest, ARoadIsNotWorthMoreThanSoManyNodesCanTell) {
  Add(Blocks({60.0, 90.0, 90.0, 90.0, 40.0}), 6000.0);
  AlignmentParts parts;
  const double measured = Measure(&parts);
  const auto& path = *std::static_pointer_cast<const RecentPath<3>>(parts.path);
  EXPECT_GT(path.weight() * path.most_log_likelihood_ratio(), 10.0);
  // Four nodes that are as good as the right one would come to that.
  EXPECT_LT(measured, std::log1p(kUnseenRatios * (4.0 - 1.0)));
}

// The slow twin: each node of all histories, one by one.
TEST_F(ChanceRatioTest, ItIsTheMeanOverAllNodesWhereTheseAreFew) {
  Add(Blocks({90.0, 70.0, 90.0, 90.0}), 6000.0);
  Add(Blocks({90.0, 90.0, 50.0, 90.0}), -7000.0);
  AlignmentParts parts;
  const double measured = Measure(&parts);
  const auto& path = *std::static_pointer_cast<const RecentPath<3>>(parts.path);
  const PathAxes<3> axes(path, 0.0, 0.0);
  std::vector<double> nats;
  for (const History& history : Histories()) {
    PoseTable table(history.graph, history.end);
    PathWalk<3> walk(history, path, axes, Direction::kSame, true, &table);
    for (NodeIndex j = 0; j < history.end; ++j) {
      nats.push_back(path.weight() * walk.Walk({{j, kImpossible, 0}}, nullptr)
                                         .log_likelihood_ratios[0] -
                     kJoinCost);
    }
  }
  double sum = 0.0;
  for (const double one : nats) {
    sum += std::min(std::exp(one), static_cast<double>(nats.size()));
  }
  const double mean = sum / static_cast<double>(nats.size());
  ASSERT_GT(mean, 1.0);
  EXPECT_NEAR(measured, std::log1p(kUnseenRatios * (mean - 1.0)), 1e-9);
}

TEST_F(ChanceRatioTest, APathWithoutAShapeIsLikeAllRoadsAndLosesNothing) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  steps_ = 1;
  EXPECT_EQ(Measure(), 0.0);
}

}  // namespace
}  // namespace revisit::core
