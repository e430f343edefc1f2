#include "core/search/alignment/chance.h"

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
#include "core/drive/node_index.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
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

// All headings, each as often.
std::vector<Pose> Circle() {
  std::vector<Pose> poses;
  for (double heading = 0.0; heading < 2.0 * kPi; heading += 0.01) {
    Pose pose;
    pose.x = 100.0 * std::sin(heading);
    pose.y = -100.0 * std::cos(heading);
    pose.heading = WrapHeading(heading);
    poses.push_back(pose);
  }
  return poses;
}

Drive Driven(const std::vector<Pose>& poses) {
  Drive drive((DriveSettings()));
  drive.Append(RecordingOf(poses, nullptr, 0), 1);
  return drive;
}

// Other drives around one that asks at its newest node.
class ChanceTest : public testing::Test {
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

  Chance Measure(AlignmentParts* parts = nullptr) const {
    return MeasureChance(AtEnd(), Histories(), model_, parts);
  }
  double MeasureRatio(AlignmentParts* parts = nullptr) const {
    return Measure(parts).log_ratio;
  }

  // Turns are rare on the vehicle's own roads, but for the last ones.
  std::int64_t steps_ = 150;
  const Drive asking_ = Driven(Blocks({2000.0, 90.0, 90.0, 90.0, 40.0}));
  std::vector<std::shared_ptr<const DriveView>> views_;
  std::vector<FrameRelation> ties_;
  RelativeModel model_;
};

TEST_F(ChanceTest, NothingIsMeasuredWhereTheVehicleMayBe) {
  EXPECT_EQ(MeasureRatio(), 0.0);
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 2000.0);
  ties_[0].fixed(0, 0) = ties_[0].fixed(1, 1) = 1e4;
  EXPECT_EQ(MeasureRatio(), 0.0);
}

TEST_F(ChanceTest, RoadsThatAreAlikeElsewhereCount) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  const double alike = MeasureRatio();
  EXPECT_GT(alike, 1.0);
  views_.clear();
  ties_.clear();
  Add(Blocks({2000.0}), 6000.0);
  EXPECT_LT(MeasureRatio(), 0.5 * alike);
}

TEST_F(ChanceTest, FramesThatNothingTiesTellNothing) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  ties_[0].state = FrameState::kNone;
  EXPECT_EQ(MeasureRatio(), 0.0);
  EXPECT_EQ(Measure().log_heading, 0.0);
}

// One road that is just the same adds no more than its share of the nodes.
TEST_F(ChanceTest, ARoadIsNotWorthMoreThanSoManyNodesCanTell) {
  Add(Blocks({60.0, 90.0, 90.0, 90.0, 40.0}), 6000.0);
  AlignmentParts parts;
  const double measured = MeasureRatio(&parts);
  const auto& path = *std::static_pointer_cast<const RecentPath<3>>(parts.path);
  EXPECT_GT(path.weight() * path.most_log_likelihood_ratio(), 10.0);
  // Four nodes that are as good as the right one would come to that.
  EXPECT_LT(measured, std::log1p(kUnseenRatios * (4.0 - 1.0)));
}

// The slow twin: each node of all histories, one by one.
TEST_F(ChanceTest, ItIsTheMeanOverAllNodesWhereTheseAreFew) {
  Add(Blocks({90.0, 70.0, 90.0, 90.0}), 6000.0);
  Add(Blocks({90.0, 90.0, 50.0, 90.0}), -7000.0);
  AlignmentParts parts;
  const double measured = MeasureRatio(&parts);
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

TEST_F(ChanceTest, APathWithoutAShapeIsLikeAllRoadsAndLosesNothing) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  steps_ = 1;
  EXPECT_EQ(MeasureRatio(), 0.0);
}

// A grid whose streets head as the query does.
TEST_F(ChanceTest, RoadsOfAGridHeadAsTheQueryDoesMoreOftenThanAnyWay) {
  Add(Blocks({90.0, 90.0, 90.0, 90.0}), 6000.0);
  ties_[0].transform.heading = asking_.graph().pose(AtEnd().node).heading;
  EXPECT_GT(Measure().log_heading, std::log(4.0));
  model_.opposite_direction = true;
  EXPECT_GT(Measure().log_heading, std::log(4.0));
}

TEST_F(ChanceTest, HeadingsTellNothingOfRoadsThatHeadAllWaysOrOthers) {
  Add(Circle(), 6000.0);
  EXPECT_LT(Measure().log_heading, 0.01);
  views_.clear();
  ties_.clear();
  Add(Blocks({2000.0}), 6000.0);
  ties_[0].transform.heading = 2.5;
  EXPECT_EQ(Measure().log_heading, 0.0);
}

// The slow twin: each node of all histories, one by one.
TEST_F(ChanceTest, HeadingsAreComparedAsFarAsBothAreKnown) {
  Add(Blocks({90.0, 70.0, 90.0, 90.0}), 6000.0);
  Add(Blocks({90.0, 90.0, 50.0, 90.0}), -7000.0);
  ties_[0].transform.heading = 1.5;
  ties_[1].transform.heading = 1.6;
  ties_[1].fixed(3, 3) = 0.01;
  double sum = 0.0;
  double count = 0.0;
  for (const History& history : Histories()) {
    const FramePair<3> pair(history.relation.frames(), history.relation.tie(),
                            AtEnd().node, model_.similarity.inflation);
    StateMatrix<3> tolerance = StateMatrix<3>::Zero();
    AddTolerance<3>(model_.similarity.tolerance, &tolerance);
    for (NodeIndex j = 0; j < history.end; ++j) {
      const Pose pose = history.graph.pose(j);
      const double variance =
          pair.Covariance(j, pose, ToMatrix<3>(history.graph.covariance(j)))(
              2, 2) +
          tolerance(2, 2);
      const double apart = WrapHeading(pair.query().heading - pose.heading);
      sum += std::exp(-0.5 * apart * apart / variance) /
             std::sqrt(2.0 * kPi * variance);
      ++count;
    }
  }
  EXPECT_NEAR(Measure().log_heading, std::log(2.0 * kPi * sum / count), 1e-9);
}

}  // namespace
}  // namespace revisit::core
