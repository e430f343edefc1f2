#include "client/cli/commands/show_command.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "client/cli/commands/vehicle_command.h"
#include "client/cli/names.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

struct GraphSummary {
  v1::Vehicle vehicle;
  std::int64_t nodes = 0;
  std::int64_t consecutive_edges = 0;
  std::int64_t loop_closure_edges = 0;
  double min_x = std::numeric_limits<double>::infinity();
  double max_x = -std::numeric_limits<double>::infinity();
  double min_y = std::numeric_limits<double>::infinity();
  double max_y = -std::numeric_limits<double>::infinity();
  v1::Node last;

  void Add(const v1::ExportPoseGraphResponse& part) {
    if (part.has_vehicle()) vehicle = part.vehicle();
    for (const v1::Node& node : part.nodes()) {
      ++nodes;
      min_x = std::min(min_x, node.pose().x_meters());
      max_x = std::max(max_x, node.pose().x_meters());
      min_y = std::min(min_y, node.pose().y_meters());
      max_y = std::max(max_y, node.pose().y_meters());
    }
    if (!part.nodes().empty()) last = *part.nodes().rbegin();
    for (const v1::Edge& edge : part.edges()) {
      if (edge.kind() == v1::EDGE_KIND_CONSECUTIVE) ++consecutive_edges;
      if (edge.kind() == v1::EDGE_KIND_LOOP_CLOSURE) ++loop_closure_edges;
    }
  }
};

struct Sigmas {
  // The largest standard deviation of the position in any direction of the
  // plane.
  double position = 0.0;
  double heading = 0.0;
};

Sigmas SigmasOf(const v1::Covariance& covariance) {
  const auto& v = covariance.values();
  double xx = 0.0, xy = 0.0, yy = 0.0, hh = 0.0;
  if (covariance.form() == v1::COVARIANCE_FORM_PLANAR_6 && v.size() == 6) {
    xx = v[0], xy = v[1], yy = v[3], hh = v[5];
  } else if (covariance.form() == v1::COVARIANCE_FORM_SPATIAL_10 &&
             v.size() == 10) {
    xx = v[0], xy = v[1], yy = v[4], hh = v[9];
  }
  const double largest = 0.5 * (xx + yy) + std::hypot(0.5 * (xx - yy), xy);
  return {std::sqrt(largest), std::sqrt(hh)};
}

void PrintJson(const GraphSummary& graph, std::ostream& out) {
  nlohmann::ordered_json json;
  json["vehicle"] = nlohmann::ordered_json::parse(
      ToJson(graph.vehicle, false), nullptr, /*allow_exceptions=*/false);
  json["nodeCount"] = graph.nodes;
  json["consecutiveEdgeCount"] = graph.consecutive_edges;
  json["loopClosureEdgeCount"] = graph.loop_closure_edges;
  if (graph.nodes > 0) {
    json["minXMeters"] = graph.min_x;
    json["maxXMeters"] = graph.max_x;
    json["minYMeters"] = graph.min_y;
    json["maxYMeters"] = graph.max_y;
    json["lastNode"] = nlohmann::ordered_json::parse(
        ToJson(graph.last, false), nullptr, /*allow_exceptions=*/false);
    const Sigmas sigmas = SigmasOf(graph.last.covariance());
    json["positionSigmaMeters"] = sigmas.position;
    json["headingSigmaRadians"] = sigmas.heading;
  }
  out << json.dump(1) << '\n';
}

}  // namespace

absl::Status RunShow(const Client& client, const std::string& id,
                     const Console& console) {
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(VehicleName(id));
  GraphSummary graph;
  const absl::Status status = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        graph.Add(part);
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  if (console.json) {
    PrintJson(graph, console.out);
    return absl::OkStatus();
  }
  PrintVehicle(graph.vehicle, console);
  std::vector<std::pair<std::string, std::string>> fields = {
      {"consecutive edges", std::to_string(graph.consecutive_edges)},
      {"loop-closure edges", std::to_string(graph.loop_closure_edges)}};
  if (graph.nodes > 0) {
    const Sigmas sigmas = SigmasOf(graph.last.covariance());
    fields.emplace_back(
        "x", Fixed(graph.min_x, 1) + " to " + Fixed(graph.max_x, 1) + " m");
    fields.emplace_back(
        "y", Fixed(graph.min_y, 1) + " to " + Fixed(graph.max_y, 1) + " m");
    fields.emplace_back(
        "last node",
        "sequence " + std::to_string(graph.last.sequence()) + " at (" +
            Fixed(graph.last.pose().x_meters(), 2) + ", " +
            Fixed(graph.last.pose().y_meters(), 2) + ") m, heading " +
            Fixed(graph.last.pose().heading_radians(), 4) + " rad");
    fields.emplace_back("its uncertainty", Fixed(sigmas.position, 2) + " m, " +
                                               Fixed(sigmas.heading, 4) +
                                               " rad (1 sigma)");
  }
  PrintFields(fields, console.out);
  return absl::OkStatus();
}

}  // namespace revisit::client
