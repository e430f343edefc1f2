#include "client/map/map_nodes.h"

#include <algorithm>

#include "client/trajectory/stored_poses.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {
namespace {

MapNode NodeOf(const v1::Node& node) {
  MapNode shown;
  shown.sequence = node.sequence();
  if (node.has_stamp()) shown.stamp = node.stamp();
  shown.travelled_meters = node.travelled_meters();
  shown.at = {node.pose().x_meters(), node.pose().y_meters()};
  shown.z_meters = node.pose().z_meters();
  const auto& v = node.covariance().values();
  const bool planar =
      node.covariance().form() == v1::COVARIANCE_FORM_PLANAR_6 && v.size() == 6;
  if (planar || v.size() == 10) {
    shown.xx = v[0];
    shown.xy = v[1];
    shown.yy = v[planar ? 3 : 4];
  }
  return shown;
}

}  // namespace

absl::StatusOr<v1::Vehicle> ReadMapNodes(const Client& client,
                                         const std::string& vehicle,
                                         const Terminal& terminal,
                                         std::vector<MapNode>* nodes) {
  const auto before = ReadVehicle(client, vehicle);
  if (!before.ok()) return before.status();
  v1::Vehicle exported;
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(vehicle);
  Progress progress(terminal, vehicle,
                    static_cast<std::uint64_t>(before->node_count()), "nodes");
  const std::size_t begin = nodes->size();
  const absl::Status status = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        if (part.has_vehicle()) exported = part.vehicle();
        for (const v1::Node& node : part.nodes()) {
          nodes->push_back(NodeOf(node));
        }
        progress.Update(nodes->size() - begin);
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  return exported;
}

std::size_t MapNodeAt(const std::vector<MapNode>& nodes, std::size_t begin,
                      std::size_t end, std::uint64_t sequence) {
  const auto first = nodes.begin() + static_cast<std::ptrdiff_t>(begin);
  const auto after = std::upper_bound(
      first, nodes.begin() + static_cast<std::ptrdiff_t>(end), sequence,
      [](std::uint64_t s, const MapNode& node) { return s < node.sequence; });
  return after == first ? begin
                        : static_cast<std::size_t>(after - nodes.begin() - 1);
}

}  // namespace revisit::client
