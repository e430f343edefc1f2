#include "server/service/export_pose_graph.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
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
#include "server/conversion/names.h"
#include "server/conversion/poses.h"
#include "server/fields/field_violations.h"
#include "server/service/exported_graphs.h"
#include "server/service/message_bytes.h"
#include "server/service/streaming_call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {
namespace {

// Nodes per message, which makes about 100 KiB.
constexpr core::NodeIndex kNodesAMessage = 512;
constexpr core::NodeIndex kEdgesAMessage = 4096;

// What a request asks for, and what its caller has of an earlier export.
struct Asked {
  BatchVersion version = BatchVersion::kCurrent;
  std::string nodes_id;
  std::int64_t known_nodes = 0;
};

// Identity of the nodes that are exported. Those of poses as they were sent
// have none, since each export makes them anew.
std::string NodesId(const VehicleView& view, BatchVersion version) {
  return version == BatchVersion::kAsSent ? std::string()
                                          : std::string(view.nodes_id);
}

// The first node that the caller does not have: of a graph of `size` nodes with
// this identity.
core::NodeIndex FirstNode(const std::string& nodes_id, core::NodeIndex size,
                          const Asked& asked) {
  const bool goes_on = !nodes_id.empty() && asked.nodes_id == nodes_id &&
                       asked.known_nodes >= 0 && asked.known_nodes <= size;
  return goes_on ? asked.known_nodes : 0;
}

// Writes a graph piece by piece: the next piece is made when the last has gone
// out.
//
// A client that takes nothing for slow_consumer_seconds gets no more: its call
// ends with SLOW_CONSUMER once it has read what was written, and is cut off if
// it does not for as long again.
class Export final : public WritingCall<Export> {
 public:
  // The bytes of the request live until Start() returns.
  Export(grpc::CallbackServerContext* call, const ServiceContext& context,
         const grpc::ByteBuffer* request)
      : WritingCall<Export>(call, "ExportPoseGraph", context),
        context_(context),
        request_bytes_(request),
        patience_(static_cast<std::int64_t>(
            context.limits.slow_consumer_seconds * 1000.0)) {}

 private:
  using Clock = std::chrono::steady_clock;

  void OnStart() override {
    const absl::Status status = Begin();
    if (!status.ok()) End(status);
  }

  // Ends an export whose vehicle has not come yet. One that has begun needs the
  // store no more, and goes on while the server drains.
  void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (end.at_once && !begun_) EndLocked(end.status);
  }

  // A late alarm may keep this object, so the copy is dropped now.
  void OnEnd(const absl::Status&)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    exported_.reset();
  }

  void OnWritten() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    Continue();
  }

  absl::Status Begin() {
    v1::ExportPoseGraphRequest request;
    if (absl::Status status = ParseMessage(request_bytes_, &request);
        !status.ok()) {
      return status;
    }
    const absl::StatusOr<std::string> id =
        ParseVehicleName(request.vehicle(), FieldPath().Field("vehicle"));
    if (!id.ok()) return id.status();
    const absl::StatusOr<BatchVersion> version = DecodePoseView(request.view());
    if (!version.ok()) return version.status();
    if (absl::Status status = ChooseVehicle(*id); !status.ok()) {
      return status;
    }
    const Asked asked{*version, request.nodes_id(), request.first_node_index()};
    const auto session = context_.fleet->Session(*id);
    const ViewCallback read = [self = shared_from_this(),
                               asked](const absl::StatusOr<VehicleView>& view) {
      self->OnRead(view, asked);
    };
    if (asked.version == BatchVersion::kAsSent) {
      session->ReadStored(read);
    } else {
      session->LongRead(read);
    }
    return absl::OkStatus();
  }

  // Room for a graph, or for more of one; also ends one whose caller has left.
  absl::StatusOr<Permit> Admit(std::size_t bytes) {
    if (given_up()) return GivenUpStatus();
    return room().AdmitExport(bytes);
  }

  void OnRead(const absl::StatusOr<VehicleView>& view, const Asked& asked) {
    const absl::StatusOr<std::shared_ptr<const ExportedGraph>> exported =
        view.ok() ? context_.exported_graphs->Take(
                        *view, asked.version, context_.storage,
                        [this](std::size_t bytes) { return Admit(bytes); })
                  : view.status();
    const MutexLock lock(&mutex_);
    if (ended_) return;
    if (!exported.ok()) {
      EndLocked(exported.status());
      return;
    }
    begun_ = true;
    exported_ = *exported;
    damage_ = view->damage;
    EncodeVehicle(*view, message_.mutable_vehicle());
    message_.set_nodes_id(NodesId(*view, asked.version));
    next_node_ = FirstNode(message_.nodes_id(), exported_->graph.size(), asked);
    next_consecutive_ = std::max<core::NodeIndex>(next_node_, 1);
    message_.set_first_node_index(next_node_);
    alarm_ = AlarmAfter(patience_, &Export::Look);
    Continue();
  }

  void Continue() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (absl::Status status = MayContinue(); !status.ok()) {
      EndLocked(status);
      return;
    }
    AddNodes();
    if (next_node_ == exported_->graph.size()) AddEdges();
    const bool something = message_.has_vehicle() ||
                           message_.nodes_size() > 0 ||
                           message_.edges_size() > 0;
    if (!something) {
      // After all that is sound comes the status of the damage.
      EndLocked(damage_);
      return;
    }
    writing_ = true;
    write_start_ = Clock::now();
    Write(message_);
    message_.Clear();
  }

  absl::Status MayContinue() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    // Named as the reason even if the call was cut in the end, since that was
    // not the caller's doing.
    if (slow_) return SlowConsumer();
    if (given_up()) return GivenUpStatus();
    return rights().Recheck();
  }

  absl::Status SlowConsumer() const {
    const std::string limit = std::to_string(patience_.count());
    return Error(absl::StatusCode::kResourceExhausted, "SLOW_CONSUMER",
                 "the client took nothing of the export for " + limit +
                     " milliseconds, which is the limit; export again",
                 {{"limit", limit}});
  }

  // Checks whether the client has taken anything for a while.
  void Look() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const Clock::duration left =
        writing_ ? write_start_ + patience_ - Clock::now() : patience_;
    if (left > Clock::duration::zero()) {
      alarm_ = AlarmAfter(left, &Export::Look);
    } else if (!slow_) {
      slow_ = true;
      exported_.reset();
      alarm_ = AlarmAfter(patience_, &Export::Look);
    } else {
      // OnCancel() and OnWriteDone() follow.
      grpc_context_->TryCancel();
    }
  }

  void AddNodes() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const core::PoseGraph& graph = exported_->graph;
    for (core::NodeIndex i = 0; i < kNodesAMessage && next_node_ < graph.size();
         ++i, ++next_node_) {
      EncodeNode(graph, next_node_, exported_->space, true,
                 message_.add_nodes());
    }
  }

  void AddEdges() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const core::PoseGraph& graph = exported_->graph;
    while (message_.edges_size() < kEdgesAMessage &&
           next_consecutive_ < graph.size()) {
      const core::NodeIndex to = next_consecutive_++;
      if (graph.SegmentStart(to) == to) continue;
      AddEdge(to - 1, to, v1::EDGE_KIND_CONSECUTIVE);
    }
    while (message_.edges_size() < kEdgesAMessage &&
           next_loop_ < exported_->loop_edges.size()) {
      const auto& [from, to] = exported_->loop_edges[next_loop_++];
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

  const ServiceContext context_;
  const grpc::ByteBuffer* const request_bytes_;
  const std::chrono::milliseconds patience_;

  // Null once the client was found to be slow.
  std::shared_ptr<const ExportedGraph> exported_ ABSL_GUARDED_BY(mutex_);
  // The damage of the vehicle, as in VehicleView.
  absl::Status damage_ ABSL_GUARDED_BY(mutex_);
  core::NodeIndex next_node_ ABSL_GUARDED_BY(mutex_) = 0;
  core::NodeIndex next_consecutive_ ABSL_GUARDED_BY(mutex_) = 1;
  std::size_t next_loop_ ABSL_GUARDED_BY(mutex_) = 0;
  // The message that is written next; the first holds the vehicle.
  v1::ExportPoseGraphResponse message_ ABSL_GUARDED_BY(mutex_);
  Clock::time_point write_start_ ABSL_GUARDED_BY(mutex_);
  bool slow_ ABSL_GUARDED_BY(mutex_) = false;
  // Whether the graph was read.
  bool begun_ ABSL_GUARDED_BY(mutex_) = false;
  std::unique_ptr<grpc::Alarm> alarm_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

grpc::ServerWriteReactor<grpc::ByteBuffer>* StartExport(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const grpc::ByteBuffer* request) {
  const auto exporter = std::make_shared<Export>(call, context, request);
  exporter->Start();
  return exporter.get();
}

}  // namespace revisit::server
