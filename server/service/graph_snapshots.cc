#include "server/service/graph_snapshots.h"

#include "core/drive/drive.h"

namespace revisit::server {

absl::StatusOr<std::shared_ptr<const GraphSnapshot>> GraphSnapshots::Take(
    const VehicleView& view, const Admit& admit) {
  // There is one view at a time per vehicle, so nobody else makes the same copy
  // meanwhile.
  {
    const MutexLock lock(&mutex_);
    const auto found = entries_.find(view.key);
    if (found != entries_.end() && found->second.revision == view.revision) {
      if (auto snapshot = found->second.snapshot.lock()) return snapshot;
    }
  }
  absl::StatusOr<Permit> room = admit(view.drive.graph().bytes());
  if (!room.ok()) return room.status();
  auto snapshot = std::make_shared<GraphSnapshot>();
  snapshot->room = *std::move(room);
  snapshot->graph = view.drive.graph();
  snapshot->space = view.config.drive.state_space;
  snapshot->loop_edges = snapshot->graph.LoopEdges();
  const MutexLock lock(&mutex_);
  for (auto i = entries_.begin(); i != entries_.end();) {
    i = i->second.snapshot.expired() ? entries_.erase(i) : std::next(i);
  }
  entries_[view.key] = {view.revision, snapshot};
  return std::shared_ptr<const GraphSnapshot>(std::move(snapshot));
}

}  // namespace revisit::server
