// Which nodes a rejected pair of nodes keeps from being sought: in one drive,
// or between two.
#ifndef REVISIT_CORE_DRIVE_REJECTED_PLACES_H_
#define REVISIT_CORE_DRIVE_REJECTED_PLACES_H_

#include <algorithm>

#include "core/drive/node_index.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"

namespace revisit::core {

// How near a query is to the one node of the pair, and a match to the other.
// Slightly more than the separation, so that nodes at exactly this distance are
// excluded too.
inline double RejectedRadiusMeters(double separation_meters) {
  return std::max(separation_meters, kPlaceRadiusMeters) * (1.0 + 1e-9);
}

// Whether a node lies so near to the rejected one along the path, in its
// recording.
inline bool IsNearRejected(const PoseGraph& graph, const Recordings& recordings,
                           NodeIndex rejected, double radius_meters,
                           NodeIndex i) {
  return recordings.Of(rejected) == recordings.Of(i) &&
         graph.MetersApart(rejected, i) <= radius_meters;
}

// The nodes nearer to the centre along the path than that, of its recording.
inline NodeRange NodesAround(const PoseGraph& graph,
                             const Recordings& recordings, NodeIndex centre,
                             double meters) {
  return Common(NodesNearer(graph, centre, meters),
                recordings.NodesOf(recordings.Of(centre), graph.size()));
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_REJECTED_PLACES_H_
