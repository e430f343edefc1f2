#include "server/service/exported_graphs.h"

#include <iterator>
#include <memory>

#include "core/drive/distance_resampler.h"
#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "server/records/proto_record_codec.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Room for so many bytes more.
absl::Status TakeRoom(std::size_t bytes, const ExportedGraphs::Admit& admit,
                      ExportedGraph* exported) {
  absl::StatusOr<Permit> room = admit(bytes);
  if (!room.ok()) return room.status();
  exported->room.push_back(*std::move(room));
  return absl::OkStatus();
}

absl::Status CopyGraph(const VehicleView& view,
                       const ExportedGraphs::Admit& admit,
                       ExportedGraph* exported) {
  const absl::Status room =
      TakeRoom(view.drive.graph().bytes(), admit, exported);
  if (room.ok()) exported->graph = view.drive.graph();
  return room;
}

// Makes the graph of a vehicle's poses as they were sent, as a drive would.
class GraphAsSent {
 public:
  // All of these outlive it.
  GraphAsSent(const VehicleView& view, const ExportedGraphs::Admit& admit,
              ExportedGraph* exported)
      : view_(view),
        admit_(admit),
        exported_(exported),
        resampler_(view.drive.resampler_options()) {}

  absl::Status Read(Storage* storage) {
    if (view_.durable_sequence == 0) return absl::OkStatus();
    absl::Status taken;
    const absl::Status read = storage->ReadBatches(
        view_.key, 1, view_.durable_sequence, BatchVersion::kAsSent,
        [&](const BatchRecord& batch) {
          taken = Take(batch);
          return taken.ok();
        });
    if (!read.ok()) return read;
    if (taken.ok()) AddLoopEdges();
    return taken;
  }

 private:
  // Room is taken for so many bytes beyond the present ones.
  static constexpr std::size_t kAhead = std::size_t{1} << 20;

  absl::Status Take(const BatchRecord& batch) {
    if (exported_->graph.bytes() >= admitted_) {
      const absl::Status room = TakeRoom(kAhead, admit_, exported_);
      if (!room.ok()) return room;
      admitted_ += kAhead;
    }
    const absl::StatusOr<DecodedPoses> poses =
        ProtoRecordCodec().DecodePoses(batch.payload, view_.config);
    if (!poses.ok()) return poses.status();
    for (const core::PoseSample& sample : poses->samples) {
      (void)resampler_.Add(sample, &exported_->graph);
    }
    if (const auto& dropped = poses->dropped) {
      resampler_.Skip(dropped->last_sequence, dropped->travelled_meters,
                      dropped->transition);
    }
    return absl::OkStatus();
  }

  void AddLoopEdges() {
    core::PoseGraph& graph = exported_->graph;
    const core::DroppedStretches& dropped = view_.drive.dropped();
    for (const auto& [id, pair] : *view_.loop_closures) {
      const auto query = core::NodeOf(graph, dropped, pair.query_sequence);
      const auto matched = core::NodeOf(graph, dropped, pair.matched_sequence);
      if (query && matched && *query != *matched) {
        graph.AddLoopEdge(*query, *matched);
      }
    }
  }

  const VehicleView& view_;
  const ExportedGraphs::Admit& admit_;
  ExportedGraph* const exported_;
  core::DistanceResampler resampler_;
  std::size_t admitted_ = 0;
};

}  // namespace

absl::StatusOr<std::shared_ptr<const ExportedGraph>> ExportedGraphs::Take(
    const VehicleView& view, BatchVersion version, Storage* storage,
    const Admit& admit) {
  const Shown shown(view.key, version);
  // There is one view at a time per vehicle, so nobody else makes the same copy
  // meanwhile.
  {
    const MutexLock lock(&mutex_);
    const auto found = entries_.find(shown);
    if (found != entries_.end() && found->second.revision == view.revision) {
      if (auto exported = found->second.exported.lock()) return exported;
    }
  }
  auto exported = std::make_shared<ExportedGraph>();
  exported->space = view.config.drive.state_space;
  const absl::Status made =
      version == BatchVersion::kAsSent
          ? GraphAsSent(view, admit, exported.get()).Read(storage)
          : CopyGraph(view, admit, exported.get());
  if (!made.ok()) return made;
  exported->loop_edges = exported->graph.LoopEdges();
  const MutexLock lock(&mutex_);
  for (auto i = entries_.begin(); i != entries_.end();) {
    i = i->second.exported.expired() ? entries_.erase(i) : std::next(i);
  }
  entries_[shown] = {view.revision, exported};
  return std::shared_ptr<const ExportedGraph>(std::move(exported));
}

}  // namespace revisit::server
