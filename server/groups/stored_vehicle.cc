#include "server/groups/stored_vehicle.h"

#include <optional>
#include <utility>

#include "server/sessions/vehicle_view.h"

namespace revisit::server {
namespace {

// The first sequence from this one on whose pose is kept; that behind all poses
// if none is. Poses that were dropped together are one batch, so few are read.
absl::StatusOr<std::uint64_t> KeptFrom(Storage* storage,
                                       const RecordCodec& codec,
                                       const StoredVehicle& vehicle,
                                       std::uint64_t sequence) {
  absl::Status decoded;
  const absl::Status read = storage->ReadBatches(
      vehicle.key, sequence, vehicle.durable_sequence, BatchVersion::kCurrent,
      [&](const BatchRecord& batch) {
        const absl::StatusOr<DecodedPoses> poses =
            codec.DecodePoses(batch.payload, vehicle.config);
        decoded = poses.status();
        if (!poses.ok() || !poses->dropped) return false;
        sequence = poses->dropped->last_sequence + 1;
        return true;
      });
  if (!decoded.ok()) return decoded;
  if (!read.ok()) return read;
  return sequence;
}

}  // namespace

absl::StatusOr<StoredVehicle> FindStoredVehicle(Storage* storage,
                                                const RecordCodec& codec,
                                                const std::string& id) {
  const absl::StatusOr<VehicleRecord> record = storage->GetVehicle(id);
  if (!record.ok()) return record.status();
  // One with a damaged row has no payload, one with a damaged batch has.
  if (!record->damage.ok() && record->payload.empty()) return record->damage;
  absl::StatusOr<VehicleConfig> config = codec.DecodeVehicle(*record);
  if (!config.ok()) return config.status();
  return StoredVehicle{record->key, id, record->durable_sequence,
                       *std::move(config)};
}

absl::Status CheckPoseIsStored(Storage* storage, const RecordCodec& codec,
                               const StoredVehicle& vehicle,
                               std::uint64_t sequence) {
  if (sequence > vehicle.durable_sequence) {
    return PoseNotFound(vehicle.id, sequence, vehicle.durable_sequence);
  }
  const absl::StatusOr<std::uint64_t> next =
      KeptFrom(storage, codec, vehicle, sequence);
  if (!next.ok()) return next.status();
  if (*next == sequence) return absl::OkStatus();
  const absl::StatusOr<std::uint64_t> first =
      KeptFrom(storage, codec, vehicle, 1);
  if (!first.ok()) return first.status();
  return PoseDropped(vehicle.id, sequence, *first, *next);
}

}  // namespace revisit::server
