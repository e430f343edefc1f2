#include "server/service/exported_graphs.h"

#include "core/drive/drive.h"

namespace revisit::server {

absl::StatusOr<std::shared_ptr<const ExportedGraph>> ExportedGraphs::Take(
    const VehicleView& view, const Admit& admit) {
  // There is one view at a time per vehicle, so nobody else makes the same copy
  // meanwhile.
  {
    const MutexLock lock(&mutex_);
    const auto found = entries_.find(view.key);
    if (found != entries_.end() && found->second.revision == view.revision) {
      if (auto exported = found->second.exported.lock()) return exported;
    }
  }
  absl::StatusOr<Permit> room = admit(view.drive.graph().bytes());
  if (!room.ok()) return room.status();
  auto exported = std::make_shared<ExportedGraph>();
  exported->room = *std::move(room);
  exported->graph = view.drive.graph();
  exported->space = view.config.drive.state_space;
  exported->loop_edges = exported->graph.LoopEdges();
  const MutexLock lock(&mutex_);
  for (auto i = entries_.begin(); i != entries_.end();) {
    i = i->second.exported.expired() ? entries_.erase(i) : std::next(i);
  }
  entries_[view.key] = {view.revision, exported};
  return std::shared_ptr<const ExportedGraph>(std::move(exported));
}

}  // namespace revisit::server
