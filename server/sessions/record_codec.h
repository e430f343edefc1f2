// How a vehicle, its batches and its loop closures become bytes in the store,
// and come back.
#ifndef REVISIT_SERVER_SESSIONS_RECORD_CODEC_H_
#define REVISIT_SERVER_SESSIONS_RECORD_CODEC_H_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/measured_loop.h"
#include "core/geometry/pose.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/records.h"

namespace revisit::server {

// What a stored batch holds: poses, or what is left of poses that were dropped.
struct DecodedPoses {
  std::vector<core::PoseSample> samples;
  std::optional<core::DroppedStretch> dropped;

  // How many recordings a vehicle has more with these poses. Its first pose is
  // in its first one, whether it says so or not.
  std::size_t recordings_begun() const {
    return static_cast<std::size_t>(std::count_if(
        samples.begin(), samples.end(), [](const core::PoseSample& sample) {
          return sample.recording_start != nullptr && sample.sequence > 1;
        }));
  }
};

// A batch in core's types, with the bytes that are stored for it.
struct DecodedBatch : DecodedPoses {
  // The bytes that the storage keeps: the poses as they came.
  std::string payload;
  // The origin that the batch was decoded with, if the vehicle is geodetic.
  std::optional<GeodeticOrigin> origin;
};

struct BatchPart {
  std::size_t count = 0;
  std::string payload;
};

// Knows the bytes in the store. Thread-safe.
class RecordCodec {
 public:
  virtual ~RecordCodec() = default;
  virtual std::string EncodeVehicle(const VehicleConfig& config) const = 0;
  // Reads only key, id and payload of the record. DATA_LOSS if the payload is
  // not what EncodeVehicle makes.
  virtual absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const = 0;
  // DATA_LOSS if the payload is not that of a batch.
  virtual absl::StatusOr<DecodedPoses> DecodePoses(
      const std::string& payload, const VehicleConfig& config) const = 0;
  // 64-bit hash of each pose's content, exact to the bit, and the same in
  // whichever form a batch has it: equal hashes are taken for equal poses. None
  // of poses that were dropped. DATA_LOSS if the payload is not that of a
  // batch.
  virtual absl::StatusOr<std::vector<std::uint64_t>> Fingerprints(
      const std::string& payload) const = 0;
  // The same batch for a storage that keeps no columns (storage.h). DATA_LOSS
  // if the payload is not that of a batch.
  virtual absl::StatusOr<std::string> AsMessages(std::string payload) const = 0;
  // The payload of a batch whose poses were dropped.
  virtual std::string EncodeDropped(
      const core::DroppedStretch& stretch) const = 0;
  // The measurement in a stored pair's payload, or nothing, as in that of every
  // rejected candidate. INVALID_ARGUMENT if that is no measurement for a
  // vehicle of this state space; DATA_LOSS if the payload is not that of a
  // pair.
  virtual absl::StatusOr<std::optional<core::LoopMeasurement>>
  DecodeMeasurement(const std::string& payload,
                    core::StateSpace space) const = 0;
  // Whether the payloads of two pairs say the same, whoever decided.
  virtual bool SayTheSame(const std::string& payload,
                          const std::string& other) const = 0;
  // The payload of a pair, from when this caller has deleted it on.
  virtual std::string WithDeleter(const std::string& payload,
                                  const std::string& deleted_by) const = 0;
  // A part of a stored batch: the poses from index `first` on, `count` of them,
  // encoded as a batch of their own.
  virtual absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                                 std::size_t first,
                                                 std::size_t count) const = 0;
  // Divides a batch into batches of up to so many bytes each, in order; a pose
  // that has more is one of its own. It is not divided if the payload is not
  // that of a batch.
  virtual std::vector<BatchPart> DivideBatch(std::string payload,
                                             std::size_t count,
                                             std::size_t most_bytes) const = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_RECORD_CODEC_H_
