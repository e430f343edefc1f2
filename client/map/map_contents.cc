#include "client/map/map_contents.h"

#include <algorithm>
#include <cmath>

#include "client/map/svg.h"

namespace revisit::client {
namespace {

// Quantile of chi-square with two degrees of freedom at 0.95: -2 ln 0.05.
constexpr double kEllipseScale = 5.991464547107979;

}  // namespace

std::vector<MapStretch> StretchesOf(const MapContents& contents) {
  const std::size_t nodes = contents.nodes.size();
  const auto& recordings = contents.recordings;
  if (recordings.empty()) return {{0, nodes, kMapEstimate}};
  std::vector<MapStretch> stretches;
  for (std::size_t k = 0; k < recordings.size(); ++k) {
    stretches.push_back(
        {recordings[k].first_node,
         k + 1 < recordings.size() ? recordings[k + 1].first_node : nodes,
         recordings[k].color});
  }
  return stretches;
}

bool IsCutBefore(const std::vector<MapNode>& nodes, std::size_t index) {
  if (index == 0) return false;
  const MapNode& from = nodes[index - 1];
  const MapNode& to = nodes[index];
  return std::hypot(to.at.x - from.at.x, to.at.y - from.at.y) >
         3.0 * (to.travelled_meters - from.travelled_meters) + 10.0;
}

MapEllipse EllipseOf(const MapNode& node) {
  const double mean = 0.5 * (node.xx + node.yy);
  const double spread = std::hypot(0.5 * (node.xx - node.yy), node.xy);
  return {std::sqrt(kEllipseScale * (mean + spread)),
          std::sqrt(kEllipseScale * std::max(0.0, mean - spread)),
          0.5 * std::atan2(2.0 * node.xy, node.xx - node.yy)};
}

}  // namespace revisit::client
