#include "server/service/export_pose_graph.h"

#include <chrono>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/pose_graph.h"
#include "grpcpp/alarm.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/base/status.h"
#include "server/connections/drain.h"
#include "server/conversion/answers.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/names.h"
#include "server/service/call.h"
#include "server/service/graph_snapshots.h"
#include "server/service/message_bytes.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {
namespace {

// Nodes per message, which makes about 100 KiB.
constexpr core::NodeIndex kNodesAMessage = 512;
constexpr core::NodeIndex kEdgesAMessage = 4096;

// Writes a graph piece by piece: the next piece is made when the last has gone
// out. Held by a shared_ptr for the reasons given in stream_poses.cc.
//
// A client that takes nothing for slow_consumer_seconds gets no more: its call
// ends with SLOW_CONSUMER once it has read what was written, and is cut off if
// it does not for as long again.
class Export final : public grpc::ServerWriteReactor<grpc::ByteBuffer>,
                     public std::enable_shared_from_this<Export> {
 public:
  Export(grpc::CallbackServerContext* call, const ServiceContext& context)
      : grpc_context_(call),
        context_(context),
        patience_(static_cast<std::int64_t>(
            context.limits.slow_consumer_seconds * 1000.0)),
        call_(call, "ExportPoseGraph", context) {}

  void Start(const grpc::ByteBuffer* request) {
    self_ = shared_from_this();
    drain_watch_ =
        context_.drain->Watch([weak = weak_from_this()](const Drain::End& end) {
          const auto exporter = weak.lock();
          if (exporter != nullptr && end.at_once) exporter->Leave(end.status);
        });
    const absl::Status status = Begin(request);
    const MutexLock lock(&mutex_);
    if (!status.ok() && !finished_) End(status);
  }

  void OnWriteDone(bool ok) override {
    if (!ok) call_.MarkGivenUp();
    const MutexLock lock(&mutex_);
    writing_ = false;
    Continue();
  }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    context_.drain->Unwatch(drain_watch_);
    call_.Done();
    // May destroy this.
    const std::shared_ptr<Export> self = std::move(self_);
  }

 private:
  using Clock = std::chrono::steady_clock;

  absl::Status Begin(const grpc::ByteBuffer* bytes) {
    if (!call_.admission().ok()) return call_.admission();
    v1::ExportPoseGraphRequest request;
    if (absl::Status status = ParseMessage(bytes, &request); !status.ok()) {
      return status;
    }
    const absl::StatusOr<std::string> id =
        ParseVehicleName(request.vehicle(), FieldPath().Field("vehicle"));
    if (!id.ok()) return id.status();
    if (absl::Status status = call_.ChooseVehicle(*id); !status.ok()) {
      return status;
    }
    context_.fleet->Session(*id)->LongRead(
        [self = shared_from_this()](const absl::StatusOr<VehicleView>& view) {
          self->OnRead(view);
        });
    return absl::OkStatus();
  }

  void End(const absl::Status& status) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    finished_ = true;
    // A late alarm may keep this object, so the copy is dropped now.
    snapshot_.reset();
    Finish(call_.End(status));
  }

  void OnRead(const absl::StatusOr<VehicleView>& view) {
    const absl::StatusOr<std::shared_ptr<const GraphSnapshot>> snapshot =
        view.ok() ? context_.snapshots->Take(*view,
                                             [this](std::size_t bytes) {
                                               return call_.AdmitExport(bytes);
                                             })
                  : view.status();
    const MutexLock lock(&mutex_);
    if (finished_) return;
    if (!snapshot.ok()) {
      End(snapshot.status());
      return;
    }
    begun_ = true;
    snapshot_ = *snapshot;
    damage_ = view->damage;
    EncodeVehicle(*view, message_.mutable_vehicle());
    WatchFor(patience_);
    Continue();
  }

  // Ends an export whose vehicle has not come yet. One that has begun needs the
  // store no more.
  void Leave(const absl::Status& status) {
    const MutexLock lock(&mutex_);
    if (!finished_ && !begun_) End(status);
  }

  void Continue() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (slow_) {
      // Named as the reason even if the call was cut in the end, since that was
      // not the caller's doing.
      End(SlowConsumer());
      return;
    }
    if (call_.given_up()) {
      End(call_.GivenUpStatus());
      return;
    }
    if (absl::Status status = call_.Recheck(); !status.ok()) {
      End(status);
      return;
    }
    AddNodes();
    if (next_node_ == snapshot_->graph.size()) AddEdges();
    const bool something = message_.has_vehicle() ||
                           message_.nodes_size() > 0 ||
                           message_.edges_size() > 0;
    if (!something) {
      // After all that is sound comes the status of the damage.
      End(damage_);
      return;
    }
    WriteMessage(message_, &bytes_);
    message_.Clear();
    writing_ = true;
    write_start_ = Clock::now();
    StartWrite(&bytes_);
  }

  absl::Status SlowConsumer() const {
    const std::string limit = std::to_string(patience_.count());
    return Error(absl::StatusCode::kResourceExhausted, "SLOW_CONSUMER",
                 "the client took nothing of the export for " + limit +
                     " milliseconds, which is the limit; export again",
                 {{"limit", limit}});
  }

  // After `duration`, checks whether the client has taken anything.
  void WatchFor(Clock::duration duration)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    alarm_ = std::make_unique<grpc::Alarm>();
    alarm_->Set(std::chrono::system_clock::now() + duration,
                [weak = weak_from_this()](bool ok) {
                  const auto self = weak.lock();
                  if (ok && self != nullptr) self->Look();
                });
  }

  void Look() {
    const MutexLock lock(&mutex_);
    if (finished_) return;
    const Clock::duration left =
        writing_ ? write_start_ + patience_ - Clock::now() : patience_;
    if (left > Clock::duration::zero()) {
      WatchFor(left);
    } else if (!slow_) {
      slow_ = true;
      snapshot_.reset();
      WatchFor(patience_);
    } else {
      // OnCancel() and OnWriteDone() follow.
      grpc_context_->TryCancel();
    }
  }

  void AddNodes() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const core::PoseGraph& graph = snapshot_->graph;
    for (core::NodeIndex i = 0; i < kNodesAMessage && next_node_ < graph.size();
         ++i, ++next_node_) {
      EncodeNode(graph, next_node_, snapshot_->space, true,
                 message_.add_nodes());
    }
  }

  void AddEdges() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const core::PoseGraph& graph = snapshot_->graph;
    while (message_.edges_size() < kEdgesAMessage &&
           next_consecutive_ < graph.size()) {
      const core::NodeIndex to = next_consecutive_++;
      if (graph.SegmentStart(to) == to) continue;
      AddEdge(to - 1, to, v1::EDGE_KIND_CONSECUTIVE);
    }
    while (message_.edges_size() < kEdgesAMessage &&
           next_loop_ < snapshot_->loop_edges.size()) {
      const auto& [from, to] = snapshot_->loop_edges[next_loop_++];
      AddEdge(from, to, v1::EDGE_KIND_LOOP_CLOSURE);
    }
  }

  void AddEdge(core::NodeIndex from, core::NodeIndex to, v1::EdgeKind kind)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    v1::Edge* edge = message_.add_edges();
    edge->set_from_index(from);
    edge->set_to_index(to);
    edge->set_kind(kind);
  }

  // Not to be used after OnDone().
  grpc::CallbackServerContext* const grpc_context_;
  const ServiceContext context_;
  const std::chrono::milliseconds patience_;
  Call call_;
  Drain::WatchId drain_watch_ = -1;
  std::shared_ptr<Export> self_;

  Mutex mutex_;
  // Null once the client was found to be slow.
  std::shared_ptr<const GraphSnapshot> snapshot_ ABSL_GUARDED_BY(mutex_);
  // The damage of the vehicle, as in VehicleView.
  absl::Status damage_ ABSL_GUARDED_BY(mutex_);
  core::NodeIndex next_node_ ABSL_GUARDED_BY(mutex_) = 0;
  core::NodeIndex next_consecutive_ ABSL_GUARDED_BY(mutex_) = 1;
  std::size_t next_loop_ ABSL_GUARDED_BY(mutex_) = 0;
  // The message that is written next; the first holds the vehicle.
  v1::ExportPoseGraphResponse message_ ABSL_GUARDED_BY(mutex_);
  // Belongs to gRPC while `writing_`.
  grpc::ByteBuffer bytes_ ABSL_GUARDED_BY(mutex_);
  bool writing_ ABSL_GUARDED_BY(mutex_) = false;
  Clock::time_point write_start_ ABSL_GUARDED_BY(mutex_);
  bool slow_ ABSL_GUARDED_BY(mutex_) = false;
  // Whether the graph was read.
  bool begun_ ABSL_GUARDED_BY(mutex_) = false;
  bool finished_ ABSL_GUARDED_BY(mutex_) = false;
  std::unique_ptr<grpc::Alarm> alarm_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

grpc::ServerWriteReactor<grpc::ByteBuffer>* StartExport(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const grpc::ByteBuffer* request) {
  const auto exporter = std::make_shared<Export>(call, context);
  exporter->Start(request);
  return exporter.get();
}

}  // namespace revisit::server
