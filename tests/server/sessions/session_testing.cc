#include "tests/server/sessions/session_testing.h"

#include <sstream>

#include "core/drive/dropped_stretch.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "tests/server/plain_codec.h"

namespace revisit::server {

VehicleConfig TestConfig() {
  VehicleConfig config;
  config.uid = "uid-of-test";
  config.drive.node_spacing_meters = 1.0;
  config.drive.check_interval_meters = 5.0;
  config.drive.search.sequence_length_meters = 10.0;
  return config;
}

Snapshot Take(const VehicleView& view) {
  Snapshot snapshot;
  snapshot.durable_sequence = view.durable_sequence;
  snapshot.revision = view.revision;
  snapshot.loop_closure_count = view.loop_closure_count;
  snapshot.consistency = view.drive.consistency();
  snapshot.config = view.config;
  snapshot.damage = view.damage;
  snapshot.config_is_known = view.config_is_known;
  const core::PoseGraph& graph = view.drive.graph();
  snapshot.node_count = graph.size();
  snapshot.first_kept = view.first_kept_sequence();
  snapshot.dropped = view.drive.dropped().count();
  snapshot.travelled_meters = view.drive.travelled_meters();
  std::ostringstream text;
  text << std::hexfloat;
  for (core::NodeIndex i = 0; i < graph.size(); ++i) {
    const core::Node& node = graph.node(i);
    text << node.sequence << " " << node.fraction << " "
         << node.travelled_meters << " " << node.pose.x << " " << node.pose.y
         << " " << node.pose.heading;
    for (const double value : node.covariance.upper) text << " " << value;
    text << "\n";
  }
  for (const auto& [from, to] : graph.LoopEdges()) {
    text << from << " - " << to << "\n";
  }
  snapshot.graph = text.str();
  const auto found =
      view.search->AtEnd(view.config.drive.search, [] { return false; });
  std::ostringstream candidates;
  candidates << std::hexfloat;
  if (found.ok()) {
    for (const core::Candidate& candidate : found->candidates) {
      candidates << candidate.matched << " " << candidate.score << "\n";
    }
  }
  snapshot.candidates = candidates.str();
  return snapshot;
}

absl::StatusOr<Snapshot> Take(const absl::StatusOr<VehicleView>& view) {
  if (!view.ok()) return view.status();
  return Take(*view);
}

CreateCallback TakingCreated(const Answer<absl::StatusOr<Snapshot>>& answer) {
  return [answer](const absl::StatusOr<CreatedVehicle>& created) {
    if (!created.ok()) {
      answer.Set(created.status());
    } else if (created->view != nullptr) {
      answer.Set(Take(*created->view));
    } else {
      Snapshot snapshot;
      snapshot.durable_sequence = created->record.durable_sequence;
      snapshot.revision = created->record.revision;
      snapshot.loop_closure_count = created->record.loop_closure_count;
      snapshot.config = PlainCodec().DecodeVehicle(created->record).value();
      answer.Set(snapshot);
    }
  };
}

std::function<void(absl::StatusOr<VehicleView>)> Taking(
    const Answer<absl::StatusOr<Snapshot>>& answer) {
  return [answer](const absl::StatusOr<VehicleView>& view) {
    answer.Set(Take(view));
  };
}

absl::StatusOr<Snapshot> ReadNow(VehicleSession& session) {
  const Answer<absl::StatusOr<Snapshot>> answer;
  session.Read(Taking(answer));
  return answer.Get();
}

absl::StatusOr<Snapshot> CheckAcknowledgedNow(VehicleSession& session,
                                              std::uint64_t acked_sequence,
                                              const std::string& uid) {
  const Answer<absl::StatusOr<Snapshot>> answer;
  session.CheckAcknowledged(acked_sequence, uid, Taking(answer));
  return answer.Get();
}

absl::StatusOr<Snapshot> AcceptDataLossNow(VehicleSession& session,
                                           std::uint64_t durable_sequence) {
  const Answer<absl::StatusOr<Snapshot>> answer;
  session.AcceptDataLoss(durable_sequence, Taking(answer));
  return answer.Get();
}

absl::StatusOr<Snapshot> UpdateNow(
    VehicleSession& session,
    const std::function<absl::StatusOr<VehicleConfig>(const VehicleView&)>&
        change) {
  const Answer<absl::StatusOr<Snapshot>> answer;
  session.Update(change, Taking(answer));
  return answer.Get();
}

absl::StatusOr<RevisionResult> ReviseNow(
    VehicleSession& session,
    const std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)>&
        plan) {
  const Answer<absl::StatusOr<RevisionResult>> answer;
  session.Revise(plan, answer.Setter());
  return answer.Get();
}

absl::StatusOr<AddedPair> AddPairNow(VehicleSession& session, PairKind kind,
                                     const PosePairRecord& pair) {
  const Answer<absl::StatusOr<AddedPair>> answer;
  session.AddPosePair(kind, pair, {}, answer.Setter());
  return answer.Get();
}

absl::StatusOr<std::uint64_t> DeletePairNow(VehicleSession& session,
                                            PairKind kind,
                                            const std::string& id,
                                            const PairDeletion& deletion) {
  const Answer<absl::StatusOr<std::uint64_t>> answer;
  session.DeletePosePair(kind, id, deletion, answer.Setter());
  return answer.Get();
}

absl::Status DeleteNow(VehicleSession& session) {
  const Answer<absl::Status> answer;
  session.Delete(answer.Setter());
  return answer.Get();
}

void CloseNow(VehicleSession& session) {
  const Answer<bool> answer;
  session.Close(std::chrono::steady_clock::now(),
                [answer] { answer.Set(true); });
  answer.Get();
}

AppendRequest PlainRequest(const std::string& payload, bool wants_checks,
                           SearchOptionsDecoder options) {
  AppendRequest request;
  request.decode = [payload](const VehicleConfig& config) {
    return PlainCodec().DecodeBatch(payload, config);
  };
  if (!wants_checks) return request;
  if (!options) {
    options = [](const VehicleConfig& config) { return config.drive.search; };
  }
  request.checks = std::make_shared<const CheckOrder>(
      CheckOrder{"checks", std::move(options)});
  return request;
}

void PlainAppend::OnStaged(const absl::Status& status) {
  if (staged) staged(status);
}

void PlainAppend::OnDurable(const absl::StatusOr<Acknowledgement>& result) {
  if (durable) durable(result);
}

bool PlainAppend::ShouldStop() const { return should_stop && should_stop(); }

void PlainAppend::OnCandidates(const VehicleView& view,
                               const absl::StatusOr<core::CandidateSet>& set,
                               std::chrono::nanoseconds /*duration*/) {
  candidates(view, set);
}

void PlainAppend::OnOver() {
  if (over) over();
}

Appended Append(VehicleSession& session, const std::string& payload) {
  const Appended appended;
  auto append = std::make_shared<PlainAppend>(payload);
  append->staged = appended.staged.Setter();
  append->durable = appended.durable.Setter();
  session.Append(append->Request(), append);
  return appended;
}

absl::StatusOr<Acknowledgement> AppendNow(VehicleSession& session,
                                          const std::string& payload) {
  return Append(session, payload).durable.Get();
}

}  // namespace revisit::server
