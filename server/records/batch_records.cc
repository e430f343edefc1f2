#include "server/records/batch_records.h"

#include <utility>

#include "server/fields/covariances.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_decoder.h"
#include "server/records/stored_batch.h"

namespace revisit::server {
namespace {

// The error transition of a stored geodetic pose in the axes of the local
// frame.
std::optional<core::ErrorTransition> TurnedTransition(
    const stored::Pose& pose, const VehicleConfig& config) {
  Violations violations;
  const core::PoseSample sample =
      PoseDecoder(config, PoseSource::kStored, &violations)
          .Decode(PoseFieldsOf(pose), FieldPath());
  return violations.count() == 0 ? sample.transition : std::nullopt;
}

// The batch, with messages where it has columns.
absl::StatusOr<stored::PoseBatch> ParseMessages(const std::string& payload) {
  absl::StatusOr<stored::PoseBatch> batch = ParseBatch(payload);
  if (!batch.ok() || batch->columns().empty()) return batch;
  stored::PoseBatch messages;
  const absl::Status visited =
      VisitFields(*batch, [&messages](const PoseFields& pose) {
        SetPose(pose, messages.add_poses());
        return true;
      });
  if (!visited.ok()) return visited;
  return messages;
}

// Puts the estimate of `revised` into `stored`; all else of the stored pose
// stays.
void Replace(const PoseFields& revised, const VehicleConfig& config,
             stored::Pose* stored) {
  if (!revised.error_transition.empty()) {
    stored->mutable_error_transition()->Assign(revised.error_transition.begin(),
                                               revised.error_transition.end());
  } else if (stored->error_transition_size() > 0 && stored->has_geodetic() &&
             revised.position_kind == PoseFields::Position::kLocal) {
    // The transition speaks of the axes at the geodetic position, which go
    // away.
    const auto turned = TurnedTransition(*stored, config);
    if (turned) {
      EncodeTransition(*turned, config.drive.state_space,
                       stored->mutable_error_transition());
    }
  }
  stored->clear_position();
  stored->clear_orientation();
  stored->clear_covariance();
  SetEstimate(revised, stored);
}

// The pose begins no recording any more. Where it had no transition for that
// reason, its error is independent of those before it, as it was.
void TakeStart(const VehicleConfig& config, stored::Pose* pose) {
  if (pose->has_recording_start() && pose->error_transition().empty() &&
      core::NoiseOf(config.drive.search.correlation_model)
          .carries_transitions) {
    core::ErrorTransition none;
    none.values.fill(0.0);
    EncodeTransition(none, config.drive.state_space,
                     pose->mutable_error_transition());
  }
  pose->clear_recording_start();
}

}  // namespace

void BatchEncoder::Measure(const PoseFields& pose) {
  stored_.emplace_back(pose);
  bytes_ += BytesInBatch(stored_.back().size());
}

std::uint8_t* BatchEncoder::Add(const StoredPose& stored,
                                const PoseFields& pose, std::uint8_t* next) {
  return stored.Write(pose, BeginPose(stored.size(), next));
}

absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    RevisedStarts starts, const RevisedPose& revised) {
  absl::StatusOr<stored::PoseBatch> batch = ParseMessages(stored.payload);
  if (!batch.ok()) return batch.status();
  bool any = false;
  for (stored::Pose& pose : *batch->mutable_poses()) {
    const std::optional<PoseFields> replacement = revised(pose.sequence());
    if (!replacement) continue;
    any = true;
    Replace(*replacement, config, &pose);
    if (starts == RevisedStarts::kFirst && pose.sequence() > 1) {
      TakeStart(config, &pose);
    }
  }
  if (!any) return std::optional<BatchRecord>();
  BatchRecord record;
  record.first_sequence = stored.first_sequence;
  record.count = stored.count;
  record.payload = batch->SerializeAsString();
  return std::optional<BatchRecord>(std::move(record));
}

absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(const PoseFields&)>& visit) {
  const absl::StatusOr<stored::PoseBatch> batch = ParseBatch(stored.payload);
  if (!batch.ok()) return batch.status();
  return VisitFields(*batch, visit);
}

}  // namespace revisit::server
