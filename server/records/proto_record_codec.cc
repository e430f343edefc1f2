#include "server/records/proto_record_codec.h"

#include <xxhash.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/measured_loop.h"
#include "core/geometry/pose.h"
#include "google/protobuf/arena.h"
#include "google/protobuf/io/coded_stream.h"
#include "server/base/status.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_decoder.h"
#include "server/fields/settings_table.h"
#include "server/fields/timestamps.h"
#include "server/records/pair_content.h"
#include "server/records/stored_batch.h"
#include "server/records/stored_records.pb.h"
#include "server/sessions/vehicle_uid.h"

namespace revisit::server {
namespace {

// No vehicle travels farther.
constexpr double kMostDroppedMeters = 1e15;

// ---- Bytes of batches

// Appends the pose to payload and fingerprints.
void AddPose(const stored::Pose& pose, DecodedBatch* batch) {
  const std::size_t size = pose.ByteSizeLong();
  const std::size_t begin = batch->payload.size();
  batch->payload.resize(begin + BytesInBatch(size));
  std::uint8_t* const next =
      BeginPose(size, reinterpret_cast<std::uint8_t*>(&batch->payload[begin]));
  pose.SerializeWithCachedSizesToArray(next);
  batch->fingerprints.push_back(XXH3_64bits(next, size));
}

absl::StatusOr<DecodedBatch> DecodeDropped(const stored::PoseBatch& stored,
                                           const VehicleConfig& config) {
  const stored::DroppedPoses& given = stored.dropped();
  core::DroppedStretch stretch;
  stretch.first_sequence = given.first_sequence();
  stretch.last_sequence = given.last_sequence();
  stretch.travelled_meters = given.travelled_meters();
  // Written so that NaN is not sound.
  bool is_sound = stored.poses().empty() && stretch.first_sequence >= 1 &&
                  stretch.last_sequence >= stretch.first_sequence &&
                  stretch.travelled_meters >= 0.0 &&
                  stretch.travelled_meters <= kMostDroppedMeters;
  if (core::NoiseOf(config.drive.search.correlation_model)
          .carries_transitions) {
    auto& values = stretch.transition.emplace().values;
    is_sound = is_sound &&
               given.error_transition_size() == static_cast<int>(values.size());
    for (std::size_t i = 0; is_sound && i < values.size(); ++i) {
      values[i] = given.error_transition(static_cast<int>(i));
      is_sound = std::abs(values[i]) <= core::kMaxTransitionEntry;
    }
  }
  if (!is_sound) {
    return absl::InvalidArgumentError("dropped poses that cannot have been");
  }
  DecodedBatch batch;
  batch.dropped = stretch;
  return batch;
}

// Samples and origin; not what AddPose() makes.
absl::StatusOr<DecodedBatch> DecodeStored(const stored::PoseBatch& stored,
                                          const VehicleConfig& config) {
  if (stored.has_dropped()) return DecodeDropped(stored, config);
  Violations violations;
  PoseDecoder decoder(config, PoseSource::kStored, &violations);
  DecodedBatch batch;
  batch.samples = DecodePoses(static_cast<std::size_t>(stored.poses_size()),
                              FieldsOfEach(stored.poses()), FieldPath(),
                              &decoder, &violations, [](const PoseFields&) {});
  if (violations.count() > 0) return violations.ToStatus();
  batch.origin = decoder.origin();
  return batch;
}

absl::Status DoesNotDecode(const absl::Status& cause) {
  return Corrupt(
      absl::StrCat("a stored batch does not decode: ", cause.message()));
}

}  // namespace

// ---- Vehicles

std::string ProtoRecordCodec::EncodeVehicle(const VehicleConfig& config) const {
  stored::Vehicle vehicle;
  WriteSettings(config, vehicle.mutable_settings());
  vehicle.set_state(config.data_loss ? stored::VEHICLE_STATE_DATA_LOSS
                                     : stored::VEHICLE_STATE_ACTIVE);
  vehicle.set_damaged(config.damaged);
  EncodeTime(config.create_time_ns, vehicle.mutable_create_time());
  vehicle.set_uid(config.uid);
  vehicle.set_display_name(config.display_name);
  for (const auto& [key, value] : config.labels) {
    stored::Label* const label = vehicle.add_labels();
    label->set_key(key);
    label->set_value(value);
  }
  return vehicle.SerializeAsString();
}

absl::StatusOr<VehicleConfig> ProtoRecordCodec::DecodeVehicle(
    const VehicleRecord& record) const {
  stored::Vehicle vehicle;
  if (!vehicle.ParseFromString(record.payload)) {
    return Corrupt("a stored vehicle is not a Vehicle");
  }
  absl::StatusOr<VehicleConfig> config =
      ReadSettings(vehicle.settings(), FieldPath().Field("settings"));
  if (!config.ok()) {
    return Corrupt(absl::StrCat("a stored vehicle does not decode: ",
                                config.status().message()));
  }
  Violations violations;
  if (!vehicle.has_create_time() ||
      !CheckTimestamp(vehicle.create_time(), FieldPath(), &violations)) {
    return Corrupt("a stored vehicle has no creation time");
  }
  config->create_time_ns = ToNanoseconds(vehicle.create_time());
  config->data_loss = vehicle.state() == stored::VEHICLE_STATE_DATA_LOSS;
  config->damaged = vehicle.damaged();
  config->uid =
      vehicle.uid().empty()
          ? DerivedVehicleUid(record.key, record.id, config->create_time_ns)
          : vehicle.uid();
  config->display_name = vehicle.display_name();
  for (const stored::Label& label : vehicle.labels()) {
    config->labels.emplace(label.key(), label.value());
  }
  return config;
}

absl::StatusOr<std::optional<core::LoopMeasurement>>
ProtoRecordCodec::DecodeMeasurement(const std::string& payload,
                                    core::StateSpace space) const {
  return DecodePairMeasurement(payload, space);
}

bool ProtoRecordCodec::SayTheSame(const std::string& payload,
                                  const std::string& other) const {
  return PairContentsSayTheSame(payload, other);
}

std::string ProtoRecordCodec::WithDeleter(const std::string& payload,
                                          const std::string& deleted_by) const {
  return PairContentWithDeleter(payload, deleted_by);
}

// ---- Batches

absl::StatusOr<DecodedBatch> ProtoRecordCodec::DecodeBatch(
    const std::string& payload, const VehicleConfig& config) const {
  const absl::StatusOr<stored::PoseBatch> batch = ParseBatch(payload);
  if (!batch.ok()) return batch.status();
  absl::StatusOr<DecodedBatch> decoded = DecodeStored(*batch, config);
  if (!decoded.ok()) return DoesNotDecode(decoded.status());
  decoded->fingerprints.reserve(static_cast<std::size_t>(batch->poses_size()));
  for (const stored::Pose& pose : batch->poses()) AddPose(pose, &*decoded);
  return decoded;
}

absl::StatusOr<DecodedPoses> ProtoRecordCodec::DecodePoses(
    const std::string& payload, const VehicleConfig& config) const {
  // Four messages a pose, each allocated by itself, would take longer than all
  // else.
  google::protobuf::Arena arena;
  auto* const batch =
      google::protobuf::Arena::CreateMessage<stored::PoseBatch>(&arena);
  if (!batch->ParseFromString(payload)) return NotABatch();
  absl::StatusOr<DecodedBatch> decoded = DecodeStored(*batch, config);
  if (!decoded.ok()) return DoesNotDecode(decoded.status());
  return DecodedPoses(*std::move(decoded));
}

std::string ProtoRecordCodec::EncodeDropped(
    const core::DroppedStretch& stretch) const {
  stored::PoseBatch batch;
  stored::DroppedPoses* const dropped = batch.mutable_dropped();
  dropped->set_first_sequence(stretch.first_sequence);
  dropped->set_last_sequence(stretch.last_sequence);
  dropped->set_travelled_meters(
      std::min(stretch.travelled_meters, kMostDroppedMeters));
  if (stretch.transition) {
    for (const double value : stretch.transition->values) {
      dropped->add_error_transition(value);
    }
  }
  return batch.SerializeAsString();
}

absl::StatusOr<std::string> ProtoRecordCodec::SliceBatch(
    const std::string& payload, std::size_t first, std::size_t count) const {
  absl::StatusOr<stored::PoseBatch> batch = ParseBatch(payload);
  if (!batch.ok()) return batch.status();
  const auto size = static_cast<std::size_t>(batch->poses_size());
  if (first > size || count > size - first) {
    return Corrupt(absl::StrCat("a stored batch has ", size,
                                " poses; asked for ", count, " from ", first));
  }
  auto* const poses = batch->mutable_poses();
  poses->DeleteSubrange(static_cast<int>(first + count),
                        static_cast<int>(size - first - count));
  poses->DeleteSubrange(0, static_cast<int>(first));
  return batch->SerializeAsString();
}

std::vector<BatchPart> ProtoRecordCodec::DivideBatch(
    std::string payload, std::size_t count, std::size_t most_bytes) const {
  std::vector<BatchPart> parts;
  if (payload.size() > most_bytes) {
    google::protobuf::io::CodedInputStream stream(
        reinterpret_cast<const std::uint8_t*>(payload.data()),
        static_cast<int>(payload.size()));
    std::size_t begin = 0;
    std::size_t end = 0;
    std::size_t poses = 0;
    const auto finish = [&] {
      parts.push_back({poses, payload.substr(begin, end - begin)});
      begin = end;
      poses = 0;
    };
    std::uint32_t size = 0;
    while (stream.ReadTag() == kPosesTag && stream.ReadVarint32(&size) &&
           stream.Skip(static_cast<int>(size))) {
      const auto next = static_cast<std::size_t>(stream.CurrentPosition());
      if (poses > 0 && next - begin > most_bytes) finish();
      end = next;
      ++poses;
    }
    if (poses > 0) finish();
    if (end == payload.size()) return parts;
    parts.clear();
  }
  parts.push_back({count, std::move(payload)});
  return parts;
}

}  // namespace revisit::server
