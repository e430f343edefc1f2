#include "client/map/map_html.h"

#include <cmath>
#include <cstddef>
#include <utility>

#include "absl/strings/str_replace.h"
#include "client/answers/exact_text.h"
#include "client/map/map_page.h"
#include "client/map/svg.h"
#include "client/revisit/printable_text.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Json = nlohmann::ordered_json;

// To the millimetre: pages of long drives are large.
double Rounded(double meters) { return std::round(meters * 1e3) / 1e3; }

Json NodesJson(const std::vector<MapNode>& nodes) {
  Json x = Json::array(), y = Json::array(), cut = Json::array(),
       sequence = Json::array(), travelled = Json::array(),
       time = Json::array();
  bool stamped = false;
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const MapNode& node = nodes[i];
    x.push_back(Rounded(node.at.x));
    y.push_back(Rounded(node.at.y));
    cut.push_back(i == 0 || IsCutBefore(nodes, i) ? 1 : 0);
    sequence.push_back(node.sequence);
    travelled.push_back(Rounded(node.travelled_meters));
    time.push_back(node.stamp ? StampText(*node.stamp) + " (" +
                                    StampSeconds(*node.stamp) + " s)"
                              : "");
    stamped = stamped || node.stamp.has_value();
  }
  Json json = {{"x", std::move(x)},
               {"y", std::move(y)},
               {"cut", std::move(cut)},
               {"sequence", std::move(sequence)},
               {"travelled", std::move(travelled)}};
  if (stamped) json["time"] = std::move(time);
  return json;
}

Json TruthJson(const std::vector<MapPoint>& truth) {
  if (truth.empty()) return nullptr;
  Json x = Json::array(), y = Json::array();
  for (const MapPoint& point : truth) {
    x.push_back(Rounded(point.x));
    y.push_back(Rounded(point.y));
  }
  return {{"x", std::move(x)}, {"y", std::move(y)}};
}

Json CheckJson(const MapContents& contents, const MapCheck& check) {
  const MapEllipse ellipse = EllipseOf(contents.nodes[check.node]);
  Json json = {
      {"node", check.node},
      {"style", check.style},
      {"ellipse", Json::array({Rounded(ellipse.major), Rounded(ellipse.minor),
                               ellipse.direction})},
      {"empty_reason", check.empty_reason},
      {"candidates", Json::array()}};
  for (const MapCandidate& candidate : check.candidates) {
    Json shown = {{"node", candidate.node},
                  {"verdict", candidate.verdict},
                  {"opposite", candidate.opposite},
                  {"gate", candidate.gate}};
    if (candidate.gate != "none") {
      shown["d2"] = candidate.squared_distance;
      shown["threshold"] = candidate.threshold;
      shown["p_value"] = candidate.p_value;
    }
    if (!candidate.frame_state.empty()) shown["frame"] = candidate.frame_state;
    if (candidate.probability) {
      shown["probability"] = *candidate.probability;
      shown["before"] = candidate.meters_before;
      shown["after"] = candidate.meters_after;
    }
    json["candidates"].push_back(std::move(shown));
  }
  return json;
}

Json PairsJson(const std::vector<MapPair>& pairs) {
  Json json = Json::array();
  for (const MapPair& pair : pairs) {
    json.push_back({{"query", pair.query},
                    {"matched", pair.matched},
                    {"name", Printable(pair.name)},
                    {"note", PrintableLines(pair.note)}});
  }
  return json;
}

Json ContentsJson(const MapContents& contents) {
  Json json;
  json["title"] = Printable(contents.title);
  json["subtitle"] = contents.subtitle;
  json["colors"] = {{"estimate", kMapEstimate},
                    {"truth", kMapTruth},
                    {"ellipse", kMapEllipse},
                    {"closure", kMapClosure},
                    {"rejection", kMapRejection}};
  json["nodes"] = NodesJson(contents.nodes);
  json["own_begin"] = contents.own_begin;
  json["recordings"] = Json::array();
  for (const MapRecording& recording : contents.recordings) {
    json["recordings"].push_back({{"node", recording.first_node},
                                  {"label", Printable(recording.label)},
                                  {"color", recording.color},
                                  {"vehicle", Printable(recording.vehicle)}});
  }
  json["truth"] = TruthJson(contents.truth);
  json["styles"] = Json::array();
  for (const MapStyle& style : contents.styles) {
    json["styles"].push_back({{"label", style.label},
                              {"color", style.color},
                              {"link", style.link},
                              {"dashed", style.dashed}});
  }
  json["checks"] = Json::array();
  for (const MapCheck& check : contents.checks) {
    json["checks"].push_back(CheckJson(contents, check));
  }
  json["closures"] = PairsJson(contents.closures);
  json["rejections"] = PairsJson(contents.rejections);
  return json;
}

}  // namespace

std::string MapPage(const MapContents& contents) {
  // No name or note may end the script, or open what hides its end.
  const std::string data =
      absl::StrReplaceAll(ContentsJson(contents).dump(
                              -1, ' ', false, Json::error_handler_t::replace),
                          {{"<", "\\u003c"}});
  std::string page = kMapPage;
  const std::size_t mark = page.find(kMapDataMark);
  page.replace(mark, sizeof(kMapDataMark) - 1, data);
  return page;
}

}  // namespace revisit::client
