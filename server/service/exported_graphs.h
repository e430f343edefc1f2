// Copies of graphs that are being exported, each shared by all exports of the
// same vehicle at the same revision: so that a slow reader holds up nobody and
// still gets one revision, and many readers take the memory of one. A copy
// shares its blocks with the drive, but keeps them when the drive goes: so room
// is asked for all of it.
#ifndef REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_
#define REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/pose_graph.h"
#include "server/connections/admission.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

struct ExportedGraph {
  // Held as long as the copy exists.
  Permit room;
  core::PoseGraph graph;
  core::StateSpace space = core::StateSpace::kPlanar;
  std::vector<std::pair<core::NodeIndex, core::NodeIndex>> loop_edges;
};

// Thread-safe.
class ExportedGraphs {
 public:
  using Admit = std::function<absl::StatusOr<Permit>(std::size_t bytes)>;

  // The graph as the view shows it. If there is no copy, `admit` is asked for
  // room: one is made, or its refusal is returned.
  absl::StatusOr<std::shared_ptr<const ExportedGraph>> Take(
      const VehicleView& view, const Admit& admit);

 private:
  struct Entry {
    std::uint64_t revision = 0;
    std::weak_ptr<const ExportedGraph> exported;
  };

  Mutex mutex_;
  // The last copy of each vehicle; some may have expired.
  std::unordered_map<VehicleKey, Entry> entries_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_
