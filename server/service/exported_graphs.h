// Copies of graphs that are being exported, each shared by all exports of the
// same vehicle at the same revision: so that a slow reader holds up nobody and
// still gets one revision, and many readers take the memory of one. A copy
// shares its blocks with the drive, but keeps them when the drive goes: so room
// is asked for all of it. The graph of poses as they were sent is no copy: it
// is made from the store.
#ifndef REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_
#define REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/pose_graph.h"
#include "server/connections/admission.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

struct ExportedGraph {
  // Held as long as the copy exists.
  std::vector<Permit> room;
  core::PoseGraph graph;
  core::StateSpace space = core::StateSpace::kPlanar;
  std::vector<std::pair<core::NodeIndex, core::NodeIndex>> loop_edges;
};

// Thread-safe.
class ExportedGraphs {
 public:
  using Admit = std::function<absl::StatusOr<Permit>(std::size_t bytes)>;

  // The graph as the view shows it, of poses of this version. If there is no
  // copy, `admit` is asked for room: one is made, or its refusal is returned.
  // As sent, all poses are read, and it is asked again as the graph grows;
  // errors are those of the storage, too. REQUIRES: for that, a view of
  // VehicleSession::ReadStored().
  absl::StatusOr<std::shared_ptr<const ExportedGraph>> Take(
      const VehicleView& view, BatchVersion version, Storage* storage,
      const Admit& admit);

 private:
  using Shown = std::pair<VehicleKey, BatchVersion>;
  struct Entry {
    std::uint64_t revision = 0;
    std::weak_ptr<const ExportedGraph> exported;
  };

  Mutex mutex_;
  // The last copy of each vehicle and version; some may have expired.
  std::map<Shown, Entry> entries_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_EXPORTED_GRAPHS_H_
