// Reads a vehicle's rows in the store: for the session that has the vehicle,
// and for those who do not load it.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_READER_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_READER_H_

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/geometry/pose.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

// Thread-safe. Storage and codec must outlive it.
struct VehicleReader {
  VehicleReader(std::string vehicle_id, Storage* vehicle_storage,
                const RecordCodec* record_codec)
      : id(std::move(vehicle_id)),
        storage(vehicle_storage),
        codec(record_codec) {}

  // The config in the vehicle's row. DATA_LOSS if it is not one that a vehicle
  // can have.
  absl::StatusOr<VehicleConfig> DecodeConfig(const VehicleRecord& record) const;

  // Decodes a stored batch. DATA_LOSS if it is not what its row says.
  absl::StatusOr<DecodedPoses> DecodeStoredPoses(
      const BatchRecord& batch, const VehicleConfig& with_config) const;

  // The current poses of the batch that holds a pose. REQUIRES: it is stored.
  absl::StatusOr<std::vector<core::PoseSample>> ReadPosesAround(
      VehicleKey key, std::uint64_t sequence,
      const VehicleConfig& with_config) const;

  // Errors about this vehicle: DATA_LOSS (STORE_CORRUPT).
  absl::Status Corrupt(const std::string& cause) const;
  absl::Status HoldsOthers(const BatchRecord& batch) const;

  const std::string id;
  Storage* const storage;
  const RecordCodec* const codec;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_READER_H_
