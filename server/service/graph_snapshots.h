// Copies of graphs that are being exported, each shared by all who export the
// same vehicle at the same revision: so that a slow reader holds up nobody and
// still gets one revision, and many readers take no more than one.
#ifndef REVISIT_SERVER_SERVICE_GRAPH_SNAPSHOTS_H_
#define REVISIT_SERVER_SERVICE_GRAPH_SNAPSHOTS_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/graph/pose_graph.h"
#include "server/connections/admission.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {

struct GraphSnapshot {
  // For as long as the copy is there.
  Permit room;
  core::PoseGraph graph;
  core::StateSpace space = core::StateSpace::kPlanar;
  std::vector<std::pair<core::NodeIndex, core::NodeIndex>> loop_edges;
};

// Thread-safe.
class GraphSnapshots {
 public:
  using Admit = std::function<absl::StatusOr<Permit>(std::size_t bytes)>;

  // The graph as the view shows it. A copy is made if there is none and `admit`
  // has room for it; else its refusal is the answer.
  absl::StatusOr<std::shared_ptr<const GraphSnapshot>> Take(
      const VehicleView& view, const Admit& admit);

 private:
  struct Entry {
    std::uint64_t revision = 0;
    std::weak_ptr<const GraphSnapshot> snapshot;
  };

  Mutex mutex_;
  // The last of each vehicle; some may have gone.
  std::unordered_map<VehicleKey, Entry> entries_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GRAPH_SNAPSHOTS_H_
