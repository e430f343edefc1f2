#include "client/map/map_geojson.h"

#include <cmath>
#include <cstddef>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/exact_text.h"
#include "client/formats/angles.h"
#include "client/trajectory/local_pose.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Json = nlohmann::ordered_json;

class GeoJson {
 public:
  explicit GeoJson(const ServerMap& map)
      : map_(map), contents_(map.contents), frame_(map.vehicle.settings()) {}

  Json Collection() {
    AddTrajectory();
    for (const MapCheck& check : contents_.checks) AddCheck(check);
    for (const MapPair& pair : contents_.closures) {
      AddPair("loop_closure", pair);
    }
    for (const MapPair& pair : contents_.rejections) {
      AddPair("rejected_candidate", pair);
    }
    Json collection;
    collection["type"] = "FeatureCollection";
    collection["features"] = std::move(features_);
    return collection;
  }

 private:
  // To 1e-8 degrees, a millimetre.
  static double Rounded(double degrees) {
    return std::round(degrees * 1e8) / 1e8;
  }

  Json Position(const MapPoint& at, double z) const {
    const v1::GeodeticPosition position = frame_.ToGeodetic({at.x, at.y, z});
    return Json::array({Rounded(position.longitude_degrees()),
                        Rounded(position.latitude_degrees())});
  }
  Json Position(std::size_t node) const {
    return Position(contents_.nodes[node].at, contents_.nodes[node].z_meters);
  }

  void Add(const char* type, Json coordinates, Json properties) {
    Json feature;
    feature["type"] = "Feature";
    feature["geometry"] = {{"type", type},
                           {"coordinates", std::move(coordinates)}};
    feature["properties"] = std::move(properties);
    features_.push_back(std::move(feature));
  }

  void AddTrajectory() {
    Json lines = Json::array();
    for (std::size_t i = 0; i < contents_.nodes.size(); ++i) {
      if (i == 0 || IsCutBefore(contents_.nodes, i)) {
        lines.push_back(Json::array());
      }
      lines.back().push_back(Position(i));
    }
    // A line has two positions at least.
    for (Json& line : lines) {
      if (line.size() == 1) line.push_back(line.front());
    }
    Add("MultiLineString", std::move(lines),
        {{"kind", "trajectory"},
         {"vehicle", map_.vehicle.name()},
         {"revision", map_.vehicle.revision()},
         {"travelled_m", contents_.nodes.back().travelled_meters}});
  }

  // `prefix` of the properties' names: "query" or "matched".
  void Describe(const std::string& prefix, std::size_t index,
                Json* properties) const {
    const MapNode& node = contents_.nodes[index];
    (*properties)[prefix + "_sequence"] = node.sequence;
    (*properties)[prefix + "_travelled_m"] = node.travelled_meters;
    if (node.stamp) (*properties)[prefix + "_time"] = StampText(*node.stamp);
  }

  void AddEllipse(std::size_t index) {
    constexpr int kCorners = 48;
    const MapNode& node = contents_.nodes[index];
    const MapEllipse ellipse = EllipseOf(node);
    const double c = std::cos(ellipse.direction);
    const double s = std::sin(ellipse.direction);
    Json ring = Json::array();
    // Counter-clockwise, and closed.
    for (int i = 0; i <= kCorners; ++i) {
      const double angle = 2.0 * kPi * (i % kCorners) / kCorners;
      const double along = ellipse.major * std::cos(angle);
      const double across = ellipse.minor * std::sin(angle);
      ring.push_back(Position({node.at.x + c * along - s * across,
                               node.at.y + s * along + c * across},
                              node.z_meters));
    }
    Json properties = {{"kind", "uncertainty"}, {"probability", 0.95}};
    Describe("query", index, &properties);
    Add("Polygon", Json::array({std::move(ring)}), std::move(properties));
  }

  void AddCheck(const MapCheck& check) {
    AddEllipse(check.node);
    Json properties = {{"kind", "check"},
                       {"candidates", check.candidates.size()}};
    Describe("query", check.node, &properties);
    if (check.candidates.empty()) {
      properties["empty_reason"] = check.empty_reason;
    }
    Add("Point", Position(check.node), std::move(properties));
    for (std::size_t i = 0; i < check.candidates.size(); ++i) {
      AddCandidate(check, i);
    }
  }

  void AddCandidate(const MapCheck& check, std::size_t index) {
    const MapCandidate& candidate = check.candidates[index];
    Json properties = {{"kind", "candidate"},
                       {"rank", index + 1},
                       {"verdict", candidate.verdict},
                       {"direction", candidate.opposite ? "OPPOSITE" : "SAME"}};
    if (candidate.probability) {
      properties["probability"] = *candidate.probability;
      properties["meters_before"] = candidate.meters_before;
      properties["meters_after"] = candidate.meters_after;
    }
    properties["gate"] = candidate.gate;
    properties["squared_mahalanobis_distance"] = candidate.squared_distance;
    properties["threshold"] = candidate.threshold;
    properties["p_value"] = candidate.p_value;
    Describe("query", check.node, &properties);
    Describe("matched", candidate.node, &properties);
    Add("LineString",
        Json::array({Position(check.node), Position(candidate.node)}),
        std::move(properties));
  }

  void AddPair(const char* kind, const MapPair& pair) {
    Json properties = {{"kind", kind}, {"name", pair.name}};
    if (!pair.note.empty()) properties["note"] = pair.note;
    Describe("query", pair.query, &properties);
    Describe("matched", pair.matched, &properties);
    Add("LineString",
        Json::array({Position(pair.query), Position(pair.matched)}),
        std::move(properties));
  }

  const ServerMap& map_;
  const MapContents& contents_;
  const LocalFrame frame_;
  Json features_ = Json::array();
};

}  // namespace

absl::Status CheckGeodetic(const v1::Vehicle& vehicle) {
  const v1::VehicleSettings& settings = vehicle.settings();
  if (settings.coordinate_frame() == v1::COORDINATE_FRAME_GEODETIC &&
      settings.has_geodetic_origin()) {
    return absl::OkStatus();
  }
  return LocalError(absl::FailedPreconditionError(absl::StrCat(
      vehicle.name(),
      " has local positions in metres, and GeoJSON holds longitude and "
      "latitude (RFC 7946); revisit map --html and --svg draw it")));
}

void WriteGeoJson(const ServerMap& map, std::ostream& out) {
  out << JsonText(GeoJson(map).Collection(), false) << '\n';
}

}  // namespace revisit::client
