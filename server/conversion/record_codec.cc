#include "server/conversion/record_codec.h"

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
#include "server/conversion/covariances.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/pose_decoder.h"
#include "server/conversion/pose_pair_content.h"
#include "server/conversion/settings_table.h"
#include "server/conversion/stored_pose.h"
#include "server/conversion/stored_records.pb.h"
#include "server/conversion/timestamps.h"
#include "server/sessions/vehicle_uid.h"

namespace revisit::server {
namespace {

// No vehicle travels farther.
constexpr double kMostDroppedMeters = 1e15;

// Tag of the length-delimited field `repeated Pose poses = 1` of PoseBatch.
constexpr std::uint32_t kPosesTag = (1 << 3) | 2;

// ---- Poses of the API and of the store, each copied into the other. What is
// not named here is not copied; what is there already is overwritten or
// cleared, so that one message can serve for many poses.

template <typename From, typename To>
void CopyPosition(const From& from, To* to) {
  if (from.has_local()) {
    auto* const local = to->mutable_local();
    local->set_x_meters(from.local().x_meters());
    local->set_y_meters(from.local().y_meters());
    local->set_z_meters(from.local().z_meters());
  } else if (from.has_geodetic()) {
    auto* const geodetic = to->mutable_geodetic();
    geodetic->set_latitude_degrees(from.geodetic().latitude_degrees());
    geodetic->set_longitude_degrees(from.geodetic().longitude_degrees());
    geodetic->set_height_meters(from.geodetic().height_meters());
  } else {
    to->clear_position();
  }
}

template <typename From, typename To>
void CopyOrientation(const From& from, To* to) {
  if (from.has_quaternion()) {
    auto* const quaternion = to->mutable_quaternion();
    quaternion->set_x(from.quaternion().x());
    quaternion->set_y(from.quaternion().y());
    quaternion->set_z(from.quaternion().z());
    quaternion->set_w(from.quaternion().w());
  } else if (from.has_heading_radians()) {
    to->set_heading_radians(from.heading_radians());
  } else {
    to->clear_orientation();
  }
}

template <typename From, typename To>
void CopyCovariance(const From& from, To* to) {
  if (!from.has_covariance()) {
    to->clear_covariance();
    return;
  }
  auto* const covariance = to->mutable_covariance();
  using Form = decltype(covariance->form());
  covariance->set_form(static_cast<Form>(from.covariance().form()));
  *covariance->mutable_values() = from.covariance().values();
}

template <typename From, typename To>
void CopyPose(const From& from, To* to) {
  to->set_sequence(from.sequence());
  if (from.has_stamp()) {
    to->mutable_stamp()->set_seconds(from.stamp().seconds());
    to->mutable_stamp()->set_nanos(from.stamp().nanos());
  } else {
    to->clear_stamp();
  }
  CopyPosition(from, to);
  CopyOrientation(from, to);
  CopyCovariance(from, to);
  *to->mutable_error_transition() = from.error_transition();
}

// ---- Bytes of batches

std::size_t BytesInBatch(std::size_t size) {
  using google::protobuf::io::CodedOutputStream;
  return 1 + size +
         static_cast<std::size_t>(
             CodedOutputStream::VarintSize32(static_cast<std::uint32_t>(size)));
}

// Writes what comes before the bytes of a pose.
std::uint8_t* BeginPose(std::size_t size, std::uint8_t* next) {
  using google::protobuf::io::CodedOutputStream;
  next = CodedOutputStream::WriteTagToArray(kPosesTag, next);
  return CodedOutputStream::WriteVarint32ToArray(
      static_cast<std::uint32_t>(size), next);
}

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

absl::Status NotABatch() {
  return Corrupt("a stored batch is not a PoseBatch");
}

absl::StatusOr<stored::PoseBatch> ParseBatch(const std::string& payload) {
  stored::PoseBatch batch;
  if (!batch.ParseFromString(payload)) return NotABatch();
  return batch;
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
  batch.samples.reserve(static_cast<std::size_t>(stored.poses_size()));
  v1::Pose pose;
  for (int i = 0; i < stored.poses_size(); ++i) {
    const FieldPath path = FieldPath().At("poses", static_cast<std::size_t>(i));
    CopyPose(stored.poses(i), &pose);
    batch.samples.push_back(decoder.Decode(pose, path));
    if (i > 0) {
      CheckFollows(stored.poses(i - 1).sequence(), pose.sequence(), path,
                   &violations);
    }
  }
  if (violations.count() > 0) return violations.ToStatus();
  batch.origin = decoder.origin();
  return batch;
}

absl::Status DoesNotDecode(const absl::Status& cause) {
  return Corrupt(
      absl::StrCat("a stored batch does not decode: ", cause.message()));
}

// ---- Revisions

// Puts the estimate of `revised` into `stored`; all else of the stored pose
// stays.
void Replace(const v1::Pose& revised, const VehicleConfig& config,
             stored::Pose* stored) {
  if (revised.error_transition_size() > 0) {
    *stored->mutable_error_transition() = revised.error_transition();
  } else if (stored->error_transition_size() > 0 && stored->has_geodetic() &&
             revised.has_local()) {
    // The transition speaks of the axes at the geodetic position, which go
    // away.
    Violations violations;
    v1::Pose before;
    CopyPose(*stored, &before);
    const core::PoseSample sample =
        PoseDecoder(config, PoseSource::kStored, &violations)
            .Decode(before, FieldPath());
    if (violations.count() == 0 && sample.transition) {
      EncodeTransition(*sample.transition, config.drive.state_space,
                       stored->mutable_error_transition());
    }
  }
  stored->clear_position();
  CopyPosition(revised, stored);
  stored->clear_orientation();
  CopyOrientation(revised, stored);
  stored->clear_covariance();
  CopyCovariance(revised, stored);
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
  return server::DecodeMeasurement(payload, space);
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

void EncodeBatch(const google::protobuf::RepeatedPtrField<v1::Pose>& poses,
                 DecodedBatch* batch) {
  const std::vector<StoredPose> stored(poses.begin(), poses.end());
  std::size_t bytes = 0;
  for (const StoredPose& pose : stored) bytes += BytesInBatch(pose.size());
  batch->payload.resize(bytes);
  batch->fingerprints.reserve(stored.size());
  auto* next = reinterpret_cast<std::uint8_t*>(&batch->payload[0]);
  for (const StoredPose& pose : stored) {
    next = BeginPose(pose.size(), next);
    std::uint8_t* const end = pose.Write(next);
    batch->fingerprints.push_back(XXH3_64bits(next, pose.size()));
    next = end;
  }
}

absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    const RevisedPose& revised) {
  absl::StatusOr<stored::PoseBatch> batch = ParseBatch(stored.payload);
  if (!batch.ok()) return batch.status();
  bool any = false;
  for (stored::Pose& pose : *batch->mutable_poses()) {
    const v1::Pose* replacement = revised(pose.sequence());
    if (replacement == nullptr) continue;
    any = true;
    Replace(*replacement, config, &pose);
  }
  if (!any) return std::optional<BatchRecord>();
  BatchRecord record;
  record.first_sequence = stored.first_sequence;
  record.count = stored.count;
  record.payload = batch->SerializeAsString();
  return std::optional<BatchRecord>(std::move(record));
}

absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(v1::Pose*)>& visit) {
  const absl::StatusOr<stored::PoseBatch> batch = ParseBatch(stored.payload);
  if (!batch.ok()) return batch.status();
  v1::Pose pose;
  for (const stored::Pose& from : batch->poses()) {
    CopyPose(from, &pose);
    if (!visit(&pose)) break;
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
