// Maps as drawings, pages and GeoJSON.
#include <algorithm>
#include <sstream>

#include "client/map/map_geojson.h"
#include "client/map/map_html.h"
#include "client/map/map_svg.h"
#include "client/map/map_view.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::HasSubstr;
using ::testing::Not;

// A path of 101 nodes, 2 m apart, along x, and back again from the jump at node
// 50 on; one check is accepted, one has no candidate.
MapContents SmallMap() {
  MapContents contents;
  contents.title = "A </script> & B";
  contents.subtitle = "two checks";
  for (std::size_t i = 0; i <= 100; ++i) {
    MapNode node;
    node.sequence = 10 * i + 1;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.at = {i < 50 ? node.travelled_meters : 300.0 - node.travelled_meters,
               i < 50 ? 0.0 : 3.0};
    node.xx = 4.0;
    node.yy = 1.0;
    contents.nodes.push_back(node);
  }
  contents.styles = {{"accepted: 1", "#0a8f6a", true, false, 1.0},
                     {"no candidate: 1", "#ffffff", false, false, 0.0}};
  MapCheck accepted;
  accepted.node = 90;
  accepted.candidates.push_back(
      {20, "ACCEPTED", true, 0.9375, 2.0, 6.5, "path", 17.25, 21.5, 0.17});
  MapCheck none;
  none.node = 40;
  none.style = 1;
  none.empty_reason = "no place of the history is probable";
  contents.checks = {none, accepted};
  contents.closures = {{90, 21, "vehicles/a/loopClosures/x", ""}};
  contents.rejections = {
      {80, 10, "vehicles/a/rejectedCandidates/y", "a bridge\n<!--<script>"}};
  return contents;
}

TEST(MapSvg, LegendNamesWhatIsDrawn) {
  const std::string svg = DrawMap(SmallMap());
  for (const char* label :
       {"estimated trajectory", "95 % uncertainty at a check", "accepted: 1",
        "no candidate: 1", "confirmed: 1", "rejected: 1",
        "A &lt;/script&gt; &amp; B"}) {
    EXPECT_THAT(svg, HasSubstr(label));
  }
  EXPECT_THAT(svg, Not(HasSubstr("true trajectory")));
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  MapContents judged = SmallMap();
  for (const MapNode& node : judged.nodes) judged.truth.push_back(node.at);
  EXPECT_THAT(DrawMap(judged), HasSubstr("true trajectory"));
}

TEST(MapSvg, TrajectoryIsNotDrawnOverAJump) {
  const std::string svg = DrawMap(SmallMap());
  const std::size_t begin = svg.find(
      "stroke-linejoin=\"round\" "
      "stroke-linecap=\"round\" d=\"");
  ASSERT_NE(begin, std::string::npos);
  const std::string path = svg.substr(begin, svg.find("/>", begin) - begin);
  EXPECT_EQ(std::count(path.begin(), path.end(), 'M'), 2);
}

TEST(MapSvg, ArrowsPointWhereTheVehicleGoes) {
  const std::string svg = DrawMap(SmallMap());
  const std::string begin = "<path class=\"arrow\" fill=\"#1f3b57\" d=\"M";
  const auto points_right = [&](std::size_t at) {
    const std::size_t tip = at + begin.size();
    return std::stod(svg.substr(tip)) >
           std::stod(svg.substr(svg.find('L', tip) + 1));
  };
  const std::size_t first = svg.find(begin);
  ASSERT_NE(first, std::string::npos);
  EXPECT_TRUE(points_right(first));
  // The way back.
  const std::size_t last = svg.rfind(begin);
  EXPECT_FALSE(points_right(last));
}

TEST(MapSvg, OneNodeIsDrawnToo) {
  MapContents contents;
  contents.title = "one";
  contents.nodes.emplace_back();
  EXPECT_THAT(DrawMap(contents), Not(HasSubstr("nan")));
}

TEST(MapHtml, PageHoldsItsDataAndAsksNobodyForMore) {
  const std::string page = MapPage(SmallMap());
  const std::string begin = "<script type=\"application/json\" id=\"data\">";
  const std::size_t at = page.find(begin) + begin.size();
  const json data =
      json::parse(page.substr(at, page.find("</script>", at) - at));
  EXPECT_EQ(data["title"], "A </script> & B");
  EXPECT_EQ(data["nodes"]["sequence"].size(), 101u);
  EXPECT_EQ(data["nodes"]["cut"][50], 1);
  EXPECT_EQ(data["nodes"]["cut"][51], 0);
  EXPECT_FALSE(data["nodes"].contains("time"));
  EXPECT_EQ(data["truth"], nullptr);
  EXPECT_EQ(data["checks"][1]["candidates"][0]["probability"], 0.9375);
  EXPECT_EQ(data["checks"][1]["candidates"][0]["before"], 2.0);
  EXPECT_EQ(data["checks"][1]["candidates"][0]["after"], 6.5);
  EXPECT_EQ(data["checks"][0]["empty_reason"],
            "no place of the history is probable");
  EXPECT_EQ(data["closures"][0]["name"], "vehicles/a/loopClosures/x");
  EXPECT_EQ(data["rejections"][0]["note"], "a bridge\n<!--<script>");
  EXPECT_THAT(page, Not(HasSubstr("<!--<script>")));
  // The one address is the name of SVG, which nobody fetches.
  std::string rest = page;
  const std::string name = "http://www.w3.org/2000/svg";
  rest.erase(rest.find(name), name.size());
  EXPECT_THAT(rest, Not(HasSubstr("http")));
  EXPECT_THAT(rest, Not(HasSubstr("src=")));
  EXPECT_THAT(rest, Not(HasSubstr("@MAP_DATA@")));
}

TEST(MapGeoJson, HoldsLongitudeAndLatitude) {
  ServerMap map;
  map.contents = SmallMap();
  map.vehicle.set_name("vehicles/a");
  EXPECT_EQ(CheckGeodetic(map.vehicle).code(),
            absl::StatusCode::kFailedPrecondition);
  v1::VehicleSettings* settings = map.vehicle.mutable_settings();
  settings->set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
  settings->mutable_geodetic_origin()->set_latitude_degrees(60.0);
  settings->mutable_geodetic_origin()->set_longitude_degrees(10.0);
  ASSERT_TRUE(CheckGeodetic(map.vehicle).ok());
  std::ostringstream out;
  WriteGeoJson(map, out);
  const json features = json::parse(out.str())["features"];
  // The trajectory; an ellipse and a point for each check, one candidate; two
  // pairs.
  ASSERT_EQ(features.size(), 1u + 2 * 2 + 1 + 2);
  EXPECT_EQ(features[0]["geometry"]["type"], "MultiLineString");
  const json& lines = features[0]["geometry"]["coordinates"];
  ASSERT_EQ(lines.size(), 2u);
  EXPECT_EQ(lines[0][0][0], 10.0);
  EXPECT_EQ(lines[0][0][1], 60.0);
  // 98 m east.
  EXPECT_NEAR(lines[0].back()[0].get<double>(), 10.0 + 98.0 / 55800.0, 1e-5);
  const json& ring = features[1]["geometry"]["coordinates"][0];
  EXPECT_EQ(ring.front(), ring.back());
  double area = 0.0;
  for (std::size_t i = 1; i < ring.size(); ++i) {
    area += ring[i - 1][0].get<double>() * ring[i][1].get<double>() -
            ring[i][0].get<double>() * ring[i - 1][1].get<double>();
  }
  EXPECT_GT(area, 0.0) << "counter-clockwise, as RFC 7946 has it";
  const json& candidate = features[5]["properties"];
  EXPECT_EQ(candidate["kind"], "candidate");
  EXPECT_EQ(candidate["verdict"], "ACCEPTED");
  EXPECT_EQ(candidate["query_sequence"], 901);
  EXPECT_EQ(candidate["matched_sequence"], 201);
  EXPECT_EQ(features[6]["properties"]["kind"], "loop_closure");
  EXPECT_FALSE(features[6]["properties"].contains("note"));
  EXPECT_EQ(features[7]["properties"]["kind"], "rejected_candidate");
  EXPECT_EQ(features[7]["properties"]["note"], "a bridge\n<!--<script>");
}

TEST(MapView, PixelsAndMetresLeadBackToEachOther) {
  const MapView view = WholeView(SmallMap(), 10.0, 20.0, 800.0);
  const PixelPoint at = view.At({50.0, 1.0});
  EXPECT_NEAR(view.MetersAt(at).x, 50.0, 1e-9);
  EXPECT_NEAR(view.MetersAt(at).y, 1.0, 1e-9);
  EXPECT_TRUE(view.frame.Contains(at, 0.0));
}

}  // namespace
}  // namespace revisit::client
