#include "client/map/group_map.h"

#include <cstdint>
#include <string>

#include "client/formats/angles.h"
#include "client/map/map_svg.h"
#include "client/map/svg.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

constexpr char kOwn[] = "vehicles/own";
constexpr char kTied[] = "vehicles/tied";
constexpr char kLost[] = "vehicles/lost";

void AddNodes(int count, MapContents* contents) {
  for (int i = 0; i < count; ++i) {
    MapNode node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * i;
    node.at = {2.0 * i, 0.0};
    contents->nodes.push_back(node);
  }
}

v1::FrameTransform MadeFrame(const std::string& vehicle, std::uint64_t first,
                             v1::FrameState state) {
  v1::FrameTransform frame;
  frame.set_vehicle(vehicle);
  frame.set_recording(vehicle + "/recordings/" + std::to_string(first));
  frame.set_frame_state(state);
  if (state != v1::FRAME_STATE_NONE) frame.mutable_frame_pose();
  return frame;
}

v1::InterVehicleLoopClosure MadeLink(const std::string& query,
                                     std::uint64_t query_sequence,
                                     const std::string& matched,
                                     std::uint64_t matched_sequence) {
  v1::InterVehicleLoopClosure link;
  link.set_name("groups/g/loopClosures/a");
  link.mutable_query()->set_vehicle(query);
  link.mutable_query()->set_sequence(query_sequence);
  link.mutable_matched()->set_vehicle(matched);
  link.mutable_matched()->set_sequence(matched_sequence);
  return link;
}

class GroupMapTest : public ::testing::Test {
 protected:
  // Ten nodes of each other vehicle, then the vehicle's own twenty.
  GroupMapTest() {
    for (const char* name : {kLost, kTied}) {
      const std::size_t begin = map_.contents.nodes.size();
      AddNodes(10, &map_.contents);
      map_.others.push_back({name, begin, map_.contents.nodes.size()});
    }
    map_.contents.own_begin = map_.contents.nodes.size();
    AddNodes(20, &map_.contents);
    map_.contents.title = map_.contents.subtitle = "group";
    v1::FrameTransform tied = MadeFrame(kTied, 1, v1::FRAME_STATE_DATUM);
    tied.mutable_frame_pose()->set_x_meters(100.0);
    tied.mutable_frame_pose()->set_heading_radians(0.5 * kPi);
    group_.frames = {MadeFrame(kLost, 1, v1::FRAME_STATE_NONE),
                     MadeFrame(kOwn, 1, v1::FRAME_STATE_AFTER),
                     MadeFrame(kOwn, 11, v1::FRAME_STATE_SAME), tied};
    group_.frames[1].mutable_frame_pose()->set_y_meters(-30.0);
  }

  const MapPoint& At(std::size_t node) const {
    return map_.contents.nodes[node].at;
  }

  GroupOnMap group_;
  ServerMap map_;
};

TEST_F(GroupMapTest, VehiclesLieInTheFrameOfTheLastRecordingOfTheOneThatAsks) {
  PlaceVehicles(group_, kOwn, &map_);
  EXPECT_NEAR(At(13).x, 100.0, 1e-9);
  EXPECT_NEAR(At(13).y, 6.0, 1e-9);
  EXPECT_EQ(At(21).y, -30.0);
  EXPECT_EQ(At(35).x, 30.0);
  EXPECT_EQ(At(35).y, 0.0);
}

TEST_F(GroupMapTest, VehicleThatNothingTiesLiesBesideTheOthers) {
  PlaceVehicles(group_, kOwn, &map_);
  for (std::size_t i = 0; i < 10; ++i) {
    for (std::size_t other = 10; other < 40; ++other) {
      EXPECT_GT(At(i).x, At(other).x);
    }
  }
}

TEST_F(GroupMapTest, LegendNamesVehiclesAndHowWellTheyArePlaced) {
  PlaceVehicles(group_, kOwn, &map_);
  const std::string drawn = DrawMap(map_.contents);
  EXPECT_THAT(drawn, HasSubstr("lost: tied by nothing"));
  EXPECT_THAT(drawn, HasSubstr("tied: DATUM"));
  EXPECT_THAT(drawn, HasSubstr("own from 1: AFTER"));
  EXPECT_THAT(drawn, HasSubstr("own from 11: the frame of the map"));
  const auto& recordings = map_.contents.recordings;
  ASSERT_EQ(recordings.size(), 4u);
  EXPECT_NE(recordings[0].color, recordings[1].color);
  EXPECT_EQ(recordings[2].color, kMapEstimate);
  EXPECT_EQ(recordings[3].color, kMapEstimate);
  EXPECT_EQ(recordings[1].vehicle, "tied");
  EXPECT_EQ(recordings[3].vehicle, "");
}

TEST_F(GroupMapTest, LinksJoinNodesOfTheirVehicles) {
  group_.links = {MadeLink(kTied, 4, kOwn, 15),
                  MadeLink(kTied, 4, "vehicles/hidden", 1)};
  v1::InterVehicleRejectedCandidate rejected;
  *rejected.mutable_query() = group_.links[0].query();
  *rejected.mutable_matched() = group_.links[0].matched();
  group_.rejections = {rejected};
  AddPairs(group_, kOwn, &map_);
  ASSERT_EQ(map_.contents.rejections.size(), 1u);
  EXPECT_EQ(map_.contents.rejections[0].matched, 34u);
  ASSERT_EQ(map_.contents.closures.size(), 1u);
  EXPECT_EQ(map_.contents.closures[0].query, 13u);
  EXPECT_EQ(map_.contents.closures[0].matched, 34u);
  EXPECT_EQ(map_.contents.closures[0].name, "groups/g/loopClosures/a");
}

TEST_F(GroupMapTest, RecordingWithoutNodesIsNotDrawn) {
  group_.frames.push_back(MadeFrame(kTied, 500, v1::FRAME_STATE_AFTER));
  PlaceVehicles(group_, kOwn, &map_);
  EXPECT_EQ(map_.contents.recordings.size(), 4u);
}

}  // namespace
}  // namespace revisit::client
