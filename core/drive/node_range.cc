#include "core/drive/node_range.h"

#include "core/drive/pose_graph.h"

namespace revisit::core {

bool IsNearer(const PoseGraph& graph, NodeIndex centre,
              double separation_meters, NodeIndex i) {
  return i == centre || graph.MetersApart(i, centre) < separation_meters;
}

// Travelled distance grows with the index, so the nodes near the centre are a
// range.
NodeRange NodesNearer(const PoseGraph& graph, NodeIndex centre,
                      double separation_meters) {
  const auto near = [&](NodeIndex i) {
    return IsNearer(graph, centre, separation_meters, i);
  };
  return {FirstWith(0, centre, near),
          FirstWith(centre + 1, graph.size(),
                    [&](NodeIndex i) { return !near(i); })};
}

}  // namespace revisit::core
