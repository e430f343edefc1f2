#include "client/map/recording_places.h"

#include <algorithm>
#include <string>

#include "client/formats/angles.h"
#include "client/map/map_html.h"
#include "client/map/map_svg.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

// Nodes at sequences 1 to 30, ten of each recording, along x from its origin.
MapContents ThreeRuns() {
  MapContents contents;
  contents.title = contents.subtitle = "runs";
  for (int i = 0; i < 30; ++i) {
    MapNode node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * i;
    node.at = {2.0 * (i % 10), 0.0};
    node.xx = 4.0;
    node.yy = 1.0;
    contents.nodes.push_back(node);
  }
  return contents;
}

v1::Recording MadeRun(int number, v1::FrameState state) {
  v1::Recording recording;
  recording.set_label("run " + std::to_string(number));
  recording.set_first_sequence(
      static_cast<std::uint64_t>(10 * (number - 1) + 1));
  recording.set_last_sequence(static_cast<std::uint64_t>(10 * number));
  recording.set_frame_state(state);
  if (state != v1::FRAME_STATE_NONE) recording.mutable_frame_pose();
  return recording;
}

std::vector<v1::Recording> MadeRuns() {
  v1::Recording turned = MadeRun(2, v1::FRAME_STATE_DATUM);
  turned.mutable_frame_pose()->set_x_meters(100.0);
  turned.mutable_frame_pose()->set_y_meters(-5.0);
  turned.mutable_frame_pose()->set_heading_radians(0.5 * kPi);
  turned.mutable_frame_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {9.0, 0.0, 0.0, 9.0, 0.0, 0.0001}) {
    turned.mutable_frame_covariance()->add_values(value);
  }
  return {MadeRun(1, v1::FRAME_STATE_NONE), turned,
          MadeRun(3, v1::FRAME_STATE_SAME)};
}

TEST(RecordingPlacesTest, NodesAreCarriedToTheFrameOfTheLastRecording) {
  MapContents contents = ThreeRuns();
  PlaceRecordings(MadeRuns(), &contents);
  const MapNode& turned = contents.nodes[15];
  EXPECT_NEAR(turned.at.x, 100.0, 1e-9);
  EXPECT_NEAR(turned.at.y, 5.0, 1e-9);
  EXPECT_NEAR(turned.xx, 1.0, 1e-9);
  EXPECT_NEAR(turned.yy, 4.0, 1e-9);
  EXPECT_NEAR(turned.xy, 0.0, 1e-9);
  EXPECT_EQ(contents.nodes[25].at.x, 10.0);
}

TEST(RecordingPlacesTest, RecordingThatNothingTiesLiesBesideTheOthers) {
  MapContents contents = ThreeRuns();
  PlaceRecordings(MadeRuns(), &contents);
  double right = 0.0;
  for (std::size_t i = 10; i < 30; ++i) {
    right = std::max(right, contents.nodes[i].at.x);
  }
  for (std::size_t i = 0; i < 10; ++i) {
    EXPECT_GT(contents.nodes[i].at.x, right);
  }
  // Its shape stays.
  EXPECT_NEAR(contents.nodes[9].at.x - contents.nodes[0].at.x, 18.0, 1e-9);
}

TEST(RecordingPlacesTest, TwoThatNothingTiesDoNotLieOnEachOther) {
  MapContents contents = ThreeRuns();
  PlaceRecordings(
      {MadeRun(1, v1::FRAME_STATE_NONE), MadeRun(2, v1::FRAME_STATE_NONE),
       MadeRun(3, v1::FRAME_STATE_SAME)},
      &contents);
  EXPECT_GT(contents.nodes[10].at.x, contents.nodes[9].at.x);
  EXPECT_GT(contents.nodes[0].at.x, contents.nodes[29].at.x);
}

TEST(RecordingPlacesTest, DrawingsNameEachRecordingAndHowWellItsPlaceIsKnown) {
  MapContents contents = ThreeRuns();
  PlaceRecordings(MadeRuns(), &contents);
  ASSERT_EQ(contents.recordings.size(), 3u);
  EXPECT_EQ(contents.recordings[1].first_node, 10u);
  for (const std::string& drawn : {DrawMap(contents), MapPage(contents)}) {
    EXPECT_THAT(drawn, HasSubstr("run 1: tied by nothing, drawn beside"));
    EXPECT_THAT(drawn, HasSubstr("run 2: DATUM, within 3.0 m and 0.6 degrees"));
    EXPECT_THAT(drawn, HasSubstr("run 3: the last one"));
    for (const MapRecording& recording : contents.recordings) {
      EXPECT_THAT(drawn, HasSubstr(recording.color));
    }
  }
  EXPECT_THAT(DrawMap(contents), Not(HasSubstr("estimated trajectory")));
}

TEST(RecordingPlacesTest, OneRecordingIsDrawnAsEver) {
  MapContents contents = ThreeRuns();
  const std::string before = DrawMap(contents);
  PlaceRecordings({MadeRun(1, v1::FRAME_STATE_SAME)}, &contents);
  EXPECT_TRUE(contents.recordings.empty());
  EXPECT_EQ(DrawMap(contents), before);
}

TEST(RecordingPlacesTest, LegendOfManyRecordingsNamesTheNewestOnes) {
  MapContents contents = ThreeRuns();
  std::vector<v1::Recording> many;
  for (int i = 0; i < 30; ++i) {
    v1::Recording one =
        MadeRun(1, i == 29 ? v1::FRAME_STATE_SAME : v1::FRAME_STATE_AFTER);
    one.set_label("r" + std::to_string(i));
    one.set_first_sequence(static_cast<std::uint64_t>(i) + 1);
    many.push_back(one);
  }
  PlaceRecordings(many, &contents);
  const std::string svg = DrawMap(contents);
  EXPECT_THAT(svg, HasSubstr("21 recordings before these"));
  EXPECT_THAT(svg, Not(HasSubstr("r20:")));
  EXPECT_THAT(svg, HasSubstr("r21: AFTER"));
}

}  // namespace
}  // namespace revisit::client
