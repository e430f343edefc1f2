// Vehicles as the store has them, for those who do not load them. All of it
// blocks on the storage.
#ifndef REVISIT_SERVER_GROUPS_STORED_VEHICLE_H_
#define REVISIT_SERVER_GROUPS_STORED_VEHICLE_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

struct StoredVehicle {
  VehicleKey key = 0;
  std::string id;
  std::uint64_t durable_sequence = 0;
  VehicleConfig config;
};

// NOT_FOUND (VEHICLE_NOT_FOUND), or DATA_LOSS if its settings are damaged.
absl::StatusOr<StoredVehicle> FindStoredVehicle(Storage* storage,
                                                const RecordCodec& codec,
                                                const std::string& id);

// OK if the pose of this sequence is stored and was not dropped, as the batch
// says that holds it: a vehicle need not be loaded for that. NOT_FOUND
// (POSE_NOT_FOUND), OUT_OF_RANGE (POSES_DROPPED), DATA_LOSS if the batch is
// damaged.
absl::Status CheckPoseIsStored(Storage* storage, const RecordCodec& codec,
                               const StoredVehicle& vehicle,
                               std::uint64_t sequence);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_STORED_VEHICLE_H_
