#include "server/export_pose_graph.h"

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/call.h"
#include "server/field_violations.h"
#include "server/proto_conversion.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {
namespace {

using Response = v1::ExportPoseGraphResponse;

// A message of this many is about 100 KiB.
constexpr core::NodeIndex kNodesAMessage = 512;
constexpr core::NodeIndex kEdgesAMessage = 4096;

// Copies the graph, so that a slow reader holds up nobody and still gets one
// revision, then writes it piece by piece: the next piece is made when the last
// has gone out. Steps follow one another, so there is nothing to lock. Held by
// a shared_ptr for the reasons given in stream_poses.cc.
class Export final : public grpc::ServerWriteReactor<Response>,
                     public std::enable_shared_from_this<Export> {
 public:
  Export(grpc::CallbackServerContext* call, const ServiceContext& context)
      : context_(context), call_(call, "ExportPoseGraph", context) {}

  void Start(const v1::ExportPoseGraphRequest& request) {
    self_ = shared_from_this();
    if (!call_.admission().ok()) {
      Finish(call_.End(call_.admission()));
      return;
    }
    const absl::StatusOr<std::string> id =
        ParseVehicleName(request.vehicle(), FieldPath().Field("vehicle"));
    if (!id.ok()) {
      Finish(call_.End(id.status()));
      return;
    }
    if (absl::Status status = call_.ChooseVehicle(*id); !status.ok()) {
      Finish(call_.End(status));
      return;
    }
    context_.fleet->Session(*id)->LongRead(
        [self = shared_from_this()](const absl::StatusOr<VehicleView>& view) {
          self->OnRead(view);
        });
  }

  void OnWriteDone(bool ok) override {
    if (!ok) call_.MarkGivenUp();
    Continue();
  }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    call_.Done();
    // May destroy this.
    const std::shared_ptr<Export> self = std::move(self_);
  }

 private:
  void OnRead(const absl::StatusOr<VehicleView>& view) {
    if (!view.ok()) {
      Finish(call_.End(view.status()));
      return;
    }
    graph_ = view->engine.graph();
    damage_ = view->damage;
    space_ = view->config.engine.state_space;
    loop_edges_ = graph_.LoopEdges();
    EncodeVehicle(*view, message_.mutable_vehicle());
    Continue();
  }

  void Continue() {
    if (call_.given_up()) {
      Finish(call_.End(call_.GivenUpStatus()));
      return;
    }
    if (absl::Status status = call_.Recheck(); !status.ok()) {
      Finish(call_.End(status));
      return;
    }
    // The first message has the vehicle already.
    if (message_sent_) message_.Clear();
    message_sent_ = true;
    AddNodes();
    if (next_node_ == graph_.size()) AddEdges();
    const bool something = message_.has_vehicle() ||
                           message_.nodes_size() > 0 ||
                           message_.edges_size() > 0;
    if (something) {
      StartWrite(&message_);
    } else {
      // Behind all that is sound comes what is wrong with the rest.
      Finish(call_.End(damage_));
    }
  }

  void AddNodes() {
    for (core::NodeIndex i = 0;
         i < kNodesAMessage && next_node_ < graph_.size(); ++i, ++next_node_) {
      EncodeNode(graph_, next_node_, space_, true, message_.add_nodes());
    }
  }

  void AddEdges() {
    while (message_.edges_size() < kEdgesAMessage &&
           next_consecutive_ < graph_.size()) {
      const core::NodeIndex to = next_consecutive_++;
      if (graph_.SegmentStart(to) == to) continue;
      AddEdge(to - 1, to, v1::EDGE_KIND_CONSECUTIVE);
    }
    while (message_.edges_size() < kEdgesAMessage &&
           next_loop_ < loop_edges_.size()) {
      const auto& [from, to] = loop_edges_[next_loop_++];
      AddEdge(from, to, v1::EDGE_KIND_LOOP_CLOSURE);
    }
  }

  void AddEdge(core::NodeIndex from, core::NodeIndex to, v1::EdgeKind kind) {
    v1::Edge* edge = message_.add_edges();
    edge->set_from_index(from);
    edge->set_to_index(to);
    edge->set_kind(kind);
  }

  const ServiceContext context_;
  Call call_;
  std::shared_ptr<Export> self_;

  core::PoseGraph graph_;
  // See VehicleView.
  absl::Status damage_;
  core::StateSpace space_ = core::StateSpace::kPlanar;
  std::vector<std::pair<core::NodeIndex, core::NodeIndex>> loop_edges_;
  core::NodeIndex next_node_ = 0;
  core::NodeIndex next_consecutive_ = 1;
  std::size_t next_loop_ = 0;
  // Belongs to gRPC while it is written.
  Response message_;
  bool message_sent_ = false;
};

}  // namespace

grpc::ServerWriteReactor<Response>* StartExport(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const v1::ExportPoseGraphRequest& request) {
  const auto exporter = std::make_shared<Export>(call, context);
  exporter->Start(request);
  return exporter.get();
}

}  // namespace revisit::server
