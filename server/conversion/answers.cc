#include "server/conversion/answers.h"

#include <algorithm>
#include <iterator>
#include <map>
#include <set>
#include <string>

#include "core/drive/dropped_stretch.h"
#include "core/drive/findings.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_matrix.h"
#include "core/settings.h"
#include "server/conversion/findings.h"
#include "server/conversion/frames.h"
#include "server/conversion/names.h"
#include "server/conversion/vehicle_labels.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/enums.h"
#include "server/fields/timestamps.h"
#include "server/records/proto_record_codec.h"

namespace revisit::server {
namespace {

constexpr EnumRow<v1::Direction, core::Direction> kDirections[] = {
    {v1::DIRECTION_SAME, core::Direction::kSame},
    {v1::DIRECTION_OPPOSITE, core::Direction::kOpposite}};
constexpr EnumRow<v1::Verdict, core::Verdict> kVerdicts[] = {
    {v1::VERDICT_ACCEPTED, core::Verdict::kAccepted},
    {v1::VERDICT_REJECTED_BY_GATE, core::Verdict::kRejectedByGate},
    {v1::VERDICT_REJECTED_BY_SHAPE, core::Verdict::kRejectedByShape},
    {v1::VERDICT_AMBIGUOUS, core::Verdict::kAmbiguous},
    {v1::VERDICT_UNINFORMATIVE, core::Verdict::kUninformative},
    {v1::VERDICT_ILL_CONDITIONED, core::Verdict::kIllConditioned}};
// Every verdict of the API but UNSPECIFIED has a row.
static_assert(std::size(kVerdicts) == v1::Verdict_ARRAYSIZE - 1);
constexpr EnumRow<v1::GateVerdict, core::GateVerdict> kGateVerdicts[] = {
    {v1::GATE_VERDICT_ACCEPTED, core::GateVerdict::kAccepted},
    {v1::GATE_VERDICT_REJECTED, core::GateVerdict::kRejected},
    {v1::GATE_VERDICT_ILL_CONDITIONED, core::GateVerdict::kIllConditioned}};
constexpr EnumRow<v1::EmptyReason, core::EmptyReason> kEmptyReasons[] = {
    {v1::EMPTY_REASON_UNSPECIFIED, core::EmptyReason::kNotEmpty},
    {v1::EMPTY_REASON_PATH_TOO_SHORT, core::EmptyReason::kPathTooShort},
    {v1::EMPTY_REASON_NO_HISTORY, core::EmptyReason::kNoHistory},
    {v1::EMPTY_REASON_ALL_SUPPRESSED, core::EmptyReason::kAllSuppressed},
    {v1::EMPTY_REASON_NO_ALIGNMENT, core::EmptyReason::kNoAlignment},
    {v1::EMPTY_REASON_NO_PROBABLE_PLACE, core::EmptyReason::kNoProbablePlace},
    {v1::EMPTY_REASON_LIMIT_EXCEEDED, core::EmptyReason::kTooMuchWork}};
constexpr EnumRow<v1::UnsearchedReason, core::UnsearchedReason>
    kUnsearchedReasons[] = {
        {v1::UNSEARCHED_REASON_STATE_SPACE,
         core::UnsearchedReason::kStateSpace},
        {v1::UNSEARCHED_REASON_CORRELATION_MODEL,
         core::UnsearchedReason::kNoiseModel},
        {v1::UNSEARCHED_REASON_NODE_SPACING,
         core::UnsearchedReason::kNodeSpacing},
        {v1::UNSEARCHED_REASON_ALIGNMENT, core::UnsearchedReason::kAlignment}};
constexpr EnumRow<v1::Durability, Durability::Level> kDurabilities[] = {
    {v1::DURABILITY_LOCAL, Durability::Level::kLocal},
    {v1::DURABILITY_REPLICATED, Durability::Level::kReplicated},
    {v1::DURABILITY_DEFERRED, Durability::Level::kNone}};

// ---- Vehicles

void EncodeConfig(const VehicleConfig& config, v1::Vehicle* vehicle) {
  EncodeSettings(config, vehicle->mutable_settings());
  vehicle->set_state(config.data_loss ? v1::VEHICLE_STATE_DATA_LOSS
                                      : v1::VEHICLE_STATE_ACTIVE);
  EncodeTime(config.create_time_ns, vehicle->mutable_create_time());
  vehicle->set_uid(config.uid);
  EncodeLabels(config, vehicle);
}

// Whether searches with the vehicle's own options multiply the claims by the
// inflation: those that begin with a belief do not.
bool AppliesInflation(const core::DriveSettings& settings) {
  return settings.apply_inflation &&
         !core::BeginsWithBelief(settings.search, settings);
}

void EncodeConsistency(const core::Consistency& consistency, bool applied,
                       v1::Consistency* message) {
  message->set_confirmed_count(consistency.confirmed);
  message->set_rejected_count(consistency.rejected);
  if (consistency.mean_normalized_innovation_squared) {
    message->set_mean_normalized_innovation_squared(
        *consistency.mean_normalized_innovation_squared);
  }
  message->set_degrees_of_freedom(consistency.degrees_of_freedom);
  message->set_inflation(consistency.inflation);
  message->set_applied(applied);
}

// ---- Recordings

void EncodeRecordingStart(const core::RecordingStart& start,
                          core::StateSpace space, v1::RecordingStart* message) {
  message->set_label(start.label);
  switch (start.relation) {
    case core::RecordingRelation::kAfter:
      EncodeCovariance(start.covariance, space, message->mutable_after());
      return;
    case core::RecordingRelation::kDatum: {
      v1::Datum* const datum = message->mutable_datum();
      datum->set_datum_id(start.datum_id);
      EncodeStatePose(start.datum, space, datum->mutable_pose());
      EncodeCovariance(start.covariance, space, datum->mutable_covariance());
      return;
    }
    case core::RecordingRelation::kUnknown:
      message->set_unknown(true);
      return;
  }
}

// ---- Candidates

// Encodes the gate at the end (Gate) or that of the whole path (PathGate).
template <typename Message>
void EncodeGate(const core::GateResult& result, Message* gate) {
  gate->set_squared_mahalanobis_distance(result.squared_mahalanobis);
  // An integer field in Gate, where the degrees are whole.
  gate->set_degrees_of_freedom(
      static_cast<decltype(gate->degrees_of_freedom())>(
          result.degrees_of_freedom));
  gate->set_threshold(result.threshold);
  gate->set_p_value(result.p_value);
  gate->set_verdict(ToProto(kGateVerdicts, result.verdict));
}

void EncodeEvidence(const core::RelativeEvidence& evidence,
                    v1::Candidate* candidate) {
  candidate->set_probability(evidence.probability);
  if (evidence.odds_to_runner_up) {
    candidate->set_odds_to_runner_up(*evidence.odds_to_runner_up);
  }
  EncodeGate(evidence.path_gate, candidate->mutable_path_gate());
  candidate->mutable_path_gate()->set_end_squared_mahalanobis_distance(
      evidence.squared_end_difference);
  v1::ShapeEvidence* shape = candidate->mutable_shape();
  shape->set_overlap_meters(evidence.overlap_meters);
  shape->set_log_likelihood_ratio(evidence.log_likelihood_ratio);
  v1::PlaceInterval* interval = candidate->mutable_place_interval();
  interval->set_meters_before(evidence.meters_before);
  interval->set_meters_after(evidence.meters_after);
}

void EncodeDifference(const core::GatedDifference& gated,
                      core::StateSpace space, v1::PoseDifference* message) {
  const core::Pose& difference = gated.difference;
  message->set_x_meters(difference.x);
  message->set_y_meters(difference.y);
  if (space == core::StateSpace::kSpatial) {
    message->set_z_meters(difference.z);
  }
  message->set_heading_radians(difference.heading);
  EncodeCovariance(gated.covariance, space, message->mutable_covariance());
}

// Encodes where the matched node is, in its vehicle's own terms.
void EncodeMatch(const std::string& vehicle_id, const core::PoseGraph& graph,
                 const core::Recordings& recordings, core::StateSpace space,
                 core::NodeIndex matched, v1::Candidate* message) {
  EncodeNode(graph, matched, space, false, message->mutable_matched());
  message->set_recording_of_match(RecordingName(
      vehicle_id, recordings[recordings.Of(matched)].first_sequence));
}

void EncodeCandidate(const VehicleView& view, const core::Candidate& candidate,
                     const GroupScope* scope, v1::Candidate* message) {
  const core::StateSpace space = view.config.drive.state_space;
  message->set_rank(candidate.rank);
  message->set_score(candidate.score);
  if (candidate.drive) {
    const KnownHistory& other = *scope->joined->histories[*candidate.drive];
    EncodeMatch(other.vehicle_id, other.view->graph, other.view->recordings,
                space, candidate.matched, message);
    message->set_matched_vehicle(VehicleName(other.vehicle_id));
    message->set_matched_vehicle_uid(other.config.uid);
  } else {
    EncodeMatch(view.id, view.drive.graph(), view.drive.recordings(), space,
                candidate.matched, message);
  }
  message->set_frame_state(EncodeFrameState(candidate.frame_state));
  if (candidate.difference) {
    EncodeGate(candidate.difference->gate, message->mutable_gate());
    message->mutable_gate()->set_inflation(candidate.inflation);
    EncodeDifference(*candidate.difference, space,
                     message->mutable_difference());
  }
  message->set_verdict(ToProto(kVerdicts, candidate.verdict));
  message->set_direction(ToProto(kDirections, candidate.direction));
  if (candidate.relative) EncodeEvidence(*candidate.relative, message);
}

void EncodeDuration(std::chrono::nanoseconds duration,
                    google::protobuf::Duration* message) {
  message->set_seconds(duration.count() / kNanosPerSecond);
  message->set_nanos(
      static_cast<std::int32_t>(duration.count() % kNanosPerSecond));
}

// ---- Searches in groups

v1::UnsearchedReason ReasonOf(Absence absence) {
  switch (absence) {
    case Absence::kDamaged:
      return v1::UNSEARCHED_REASON_DAMAGED;
    case Absence::kMemory:
      return v1::UNSEARCHED_REASON_MEMORY;
    case Absence::kNotReady:
    case Absence::kNone:
    case Absence::kGone:
      return v1::UNSEARCHED_REASON_NOT_READY;
  }
  return v1::UNSEARCHED_REASON_UNSPECIFIED;
}

void EncodeSearched(const KnownHistory& history, std::chrono::nanoseconds lag,
                    v1::SearchedVehicle* message) {
  message->set_vehicle(VehicleName(history.vehicle_id));
  message->set_node_count(history.view->graph.size());
  message->set_last_sequence(history.last_sequence);
  EncodeDuration(lag, message->mutable_lag());
}

// Drives are in the order of the vehicles' names.
void EncodeScope(const core::CandidateSet& set, const GroupScope& scope,
                 v1::CandidateSet* message) {
  message->set_group_revision(scope.joined->group->version.revision);
  const auto now = std::chrono::steady_clock::now();
  std::map<std::string, v1::UnsearchedReason> unsearched;
  for (const AbsentMember& absent : scope.absent) {
    unsearched.emplace(absent.vehicle_id, ReasonOf(absent.absence));
  }
  std::set<std::size_t> left_out;
  for (const core::UnsearchedDrive& drive : set.unsearched) {
    left_out.insert(drive.drive);
    unsearched.emplace(scope.joined->histories[drive.drive]->vehicle_id,
                       ToProto(kUnsearchedReasons, drive.reason));
  }
  for (std::size_t d = 0; d < scope.joined->histories.size(); ++d) {
    if (scope.scope.asking == d || !scope.scope.Searches(d) ||
        left_out.count(d) > 0) {
      continue;
    }
    EncodeSearched(*scope.joined->histories[d], now - scope.as_of[d],
                   message->add_searched());
  }
  for (const auto& [vehicle_id, reason] : unsearched) {
    v1::UnsearchedVehicle* const added = message->add_unsearched();
    added->set_vehicle(VehicleName(vehicle_id));
    added->set_reason(reason);
  }
}

void EncodeAlignedPath(const core::Candidate& candidate,
                       v1::Candidate* message) {
  for (const auto& [query_index, matched_index] : candidate.path) {
    v1::AlignedPair* pair = message->add_aligned_path();
    pair->set_query_index(query_index);
    pair->set_matched_index(matched_index);
  }
}

}  // namespace

void EncodeVehicle(const VehicleView& view, v1::Vehicle* vehicle) {
  vehicle->set_name(VehicleName(view.id));
  if (view.config_is_known) EncodeConfig(view.config, vehicle);
  if (!view.damage.ok()) vehicle->set_state(v1::VEHICLE_STATE_DAMAGED);
  vehicle->set_durable_sequence(view.durable_sequence);
  vehicle->set_revision(view.revision);
  vehicle->set_node_count(view.drive.graph().size());
  vehicle->set_loop_closure_count(view.loop_closure_count);
  vehicle->set_travelled_meters(view.drive.travelled_meters());
  vehicle->set_first_kept_sequence(view.first_kept_sequence());
  vehicle->set_dropped_pose_count(view.drive.dropped().count());
  if (!view.config_is_known) return;
  if (view.config.checks == ChecksKept::kStored) {
    vehicle->set_checked_sequence(view.checks.checked_sequence);
    vehicle->set_check_debt(
        view.drive.ChecksBehind(view.checks.checked_sequence));
  }
  EncodeConsistency(view.drive.consistency(),
                    AppliesInflation(view.config.drive),
                    vehicle->mutable_consistency());
  for (const core::Finding& finding : view.drive.findings()) {
    EncodeFinding(finding, vehicle->add_findings());
  }
}

void EncodeVehicle(const VehicleRecord& record, v1::Vehicle* vehicle) {
  const absl::StatusOr<VehicleConfig> config =
      ProtoRecordCodec().DecodeVehicle(record);
  std::string name = VehicleName(record.id);
  // A damaged id may hold bytes that no message can.
  std::replace_if(
      name.begin(), name.end(), [](char c) { return c < ' ' || c > '~'; }, '?');
  vehicle->set_name(name);
  if (config.ok()) EncodeConfig(*config, vehicle);
  if (!config.ok() || !record.damage.ok() || config->damaged) {
    vehicle->set_state(v1::VEHICLE_STATE_DAMAGED);
    return;
  }
  vehicle->set_revision(record.revision);
  vehicle->set_durable_sequence(record.durable_sequence);
  vehicle->set_loop_closure_count(record.loop_closure_count);
  if (config->checks == ChecksKept::kStored) {
    vehicle->set_checked_sequence(record.checks.checked_sequence);
  }
}

void EncodeAck(const Acknowledgement& acknowledgement, v1::Ack* ack) {
  ack->set_durable_sequence(acknowledgement.durable_sequence);
  ack->set_revision(acknowledgement.revision);
  ack->clear_jumps();
  ack->clear_warnings();
  for (const core::Jump& jump : acknowledgement.jumps) {
    v1::Jump* added = ack->add_jumps();
    added->set_sequence(jump.sequence);
    added->set_distance_meters(jump.distance_meters);
  }
  for (const core::Finding& finding : acknowledgement.findings) {
    EncodeFindingWarning(finding, acknowledgement.durable_sequence,
                         ack->add_warnings());
  }
  if (acknowledgement.stamp_ahead) {
    EncodeStampWarning(*acknowledgement.stamp_ahead, ack->add_warnings());
  }
}

void EncodeNode(const core::PoseGraph& graph, core::NodeIndex index,
                core::StateSpace space, bool with_covariance, v1::Node* node) {
  const core::Node from = graph.node(index);
  node->set_index(index);
  node->set_sequence(from.sequence);
  node->set_fraction(from.fraction);
  if (from.stamp_ns) EncodeTime(*from.stamp_ns, node->mutable_stamp());
  node->set_travelled_meters(from.travelled_meters);
  EncodeStatePose(from.pose, space, node->mutable_pose());
  if (with_covariance) {
    EncodeCovariance(from.covariance, space, node->mutable_covariance());
  }
}

void EncodeRecording(const VehicleView& view, std::size_t k,
                     const core::FrameRelation& relation,
                     v1::Recording* message) {
  const core::StateSpace space = view.config.drive.state_space;
  const core::Recordings& recordings = view.drive.recordings();
  const core::Recording& recording = recordings[k];
  message->set_name(RecordingName(view.id, recording.first_sequence));
  message->set_first_sequence(recording.first_sequence);
  message->set_last_sequence(k + 1 < recordings.size()
                                 ? recordings[k + 1].first_sequence - 1
                                 : view.durable_sequence);
  if (recording.start != nullptr) {
    message->set_label(recording.start->label);
    EncodeRecordingStart(*recording.start, space, message->mutable_start());
  }
  EncodeFrame(relation, space, message);
}

void EncodeDurability(const Durability& durability,
                      v1::GetServerInfoResponse* response) {
  response->set_durability(ToProto(kDurabilities, durability.level));
  response->set_durability_settings(durability.details);
}

void EncodeStorageUsers(const std::vector<StorageUser>& users,
                        v1::GetServerInfoResponse* response) {
  for (const StorageUser& user : users) {
    v1::StoreServer* const server = response->add_servers();
    server->set_address(user.address);
    server->set_owned_vehicle_count(user.owned_vehicles);
  }
}

void EncodeCandidateSet(const VehicleView& view, const core::CandidateSet& set,
                        bool include_aligned_path,
                        std::chrono::nanoseconds search_duration,
                        v1::CandidateSet* message, const GroupScope* scope) {
  if (set.query) {
    EncodeNode(view.drive.graph(), *set.query, view.config.drive.state_space,
               false, message->mutable_query());
  }
  message->set_revision(view.revision);
  for (const core::Candidate& candidate : set.candidates) {
    v1::Candidate* added = message->add_candidates();
    *added->mutable_query() = message->query();
    EncodeCandidate(view, candidate, scope, added);
    if (include_aligned_path) EncodeAlignedPath(candidate, added);
  }
  message->set_empty_reason(ToProto(kEmptyReasons, set.empty_reason));
  message->set_nodes_considered(set.nodes_considered);
  message->set_nodes_pruned(set.nodes_pruned);
  if (set.new_place_probability) {
    message->set_new_place_probability(*set.new_place_probability);
  }
  if (set.scale) {
    v1::ScaleEstimate* estimate = message->mutable_scale_estimate();
    estimate->set_scale(set.scale->scale);
    estimate->set_low(set.scale->low);
    estimate->set_high(set.scale->high);
  }
  EncodeDuration(search_duration, message->mutable_search_duration());
  if (scope != nullptr) EncodeScope(set, *scope, message);
}

}  // namespace revisit::server
