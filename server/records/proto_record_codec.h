// The bytes in the store. They are messages of their own
// (stored_records.proto), so that the API can change without them.
#ifndef REVISIT_SERVER_RECORDS_PROTO_RECORD_CODEC_H_
#define REVISIT_SERVER_RECORDS_PROTO_RECORD_CODEC_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/measured_loop.h"
#include "server/sessions/record_codec.h"
#include "server/storage/records.h"

namespace revisit::server {

// A vehicle's payload is a serialized revisit.stored.Vehicle, a batch's a
// serialized revisit.stored.PoseBatch, a loop closure's and a rejected
// candidate's a serialized revisit.stored.PosePairContent
// (pair_content.h). The fingerprint of a pose is the XXH3-64 of its
// serialized revisit.stored.Pose, in whichever form it is stored.
class ProtoRecordCodec : public RecordCodec {
 public:
  std::string EncodeVehicle(const VehicleConfig& config) const override;
  absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const override;
  absl::StatusOr<DecodedPoses> DecodePoses(
      const std::string& payload, const VehicleConfig& config) const override;
  absl::StatusOr<std::vector<std::uint64_t>> Fingerprints(
      const std::string& payload) const override;
  absl::StatusOr<std::string> AsMessages(std::string payload) const override;
  std::string EncodeDropped(const core::DroppedStretch& stretch) const override;
  absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeMeasurement(
      const std::string& payload, core::StateSpace space) const override;
  bool SayTheSame(const std::string& payload,
                  const std::string& other) const override;
  std::string WithDeleter(const std::string& payload,
                          const std::string& deleted_by) const override;
  absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                         std::size_t first,
                                         std::size_t count) const override;
  std::vector<BatchPart> DivideBatch(std::string payload, std::size_t count,
                                     std::size_t most_bytes) const override;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_PROTO_RECORD_CODEC_H_
