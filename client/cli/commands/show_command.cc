#include "client/cli/commands/show_command.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/vehicle_command.h"
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
  out << JsonText(json, true) << '\n';
}

std::string Range(double lowest, double highest) {
  return absl::StrCat(Fixed(lowest, 1), " to ", Fixed(highest, 1), " m");
}

}  // namespace

void AddShowCommand(const Command& program) {
  const Command command =
      program.AddCommand({"show", "Summarises a vehicle's pose graph.", "",
                          "  revisit show shuttle-7"});
  const auto vehicle = std::make_shared<std::string>();
  AddVehicleName(command, vehicle.get());
  command.Runs([vehicle](const Connection& server, const Terminal& terminal) {
    return RunShow(server.client, *vehicle, terminal);
  });
}

absl::Status RunShow(const Client& client, const std::string& id,
                     const Terminal& terminal) {
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(VehicleName(id));
  GraphSummary graph;
  const absl::Status status = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        graph.Add(part);
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  if (terminal.json()) {
    PrintJson(graph, terminal.out);
    return absl::OkStatus();
  }
  PrintVehicle(graph.vehicle, terminal);
  std::vector<std::pair<std::string, std::string>> fields = {
      {"consecutive edges", absl::StrCat(graph.consecutive_edges)},
      {"loop-closure edges", absl::StrCat(graph.loop_closure_edges)}};
  if (graph.nodes > 0) {
    const v1::StatePose& last = graph.last.pose();
    const Sigmas sigmas = SigmasOf(graph.last.covariance());
    fields.emplace_back("x", Range(graph.min_x, graph.max_x));
    fields.emplace_back("y", Range(graph.min_y, graph.max_y));
    fields.emplace_back(
        "last node", absl::StrCat("sequence ", graph.last.sequence(), " at (",
                                  Fixed(last.x_meters(), 2), ", ",
                                  Fixed(last.y_meters(), 2), ") m, heading ",
                                  Fixed(last.heading_radians(), 4), " rad"));
    fields.emplace_back(
        "its uncertainty",
        absl::StrCat(Fixed(sigmas.position, 2), " m, ",
                     Fixed(sigmas.heading, 4), " rad (1 sigma)"));
  }
  PrintFields(fields, terminal.out);
  return absl::OkStatus();
}

}  // namespace revisit::client
