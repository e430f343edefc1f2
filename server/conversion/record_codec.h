// The bytes in the store. They are messages of their own
// (stored_records.proto), so that the API can change without them: only fields
// that are copied here by name reach a record.
#ifndef REVISIT_SERVER_CONVERSION_RECORD_CODEC_H_
#define REVISIT_SERVER_CONVERSION_RECORD_CODEC_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/measured_loop.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/geometry.pb.h"
#include "server/sessions/record_codec.h"
#include "server/storage/storage.h"

namespace revisit::server {

// A vehicle's payload is a serialized revisit.stored.Vehicle, a batch's a
// serialized revisit.stored.PoseBatch, a loop closure's and a rejected
// candidate's a serialized revisit.stored.PosePairContent
// (pose_pair_content.h). The fingerprint of a pose is the XXH3-64 of its
// serialized revisit.stored.Pose.
class ProtoRecordCodec : public RecordCodec {
 public:
  std::string EncodeVehicle(const VehicleConfig& config) const override;
  absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const override;
  absl::StatusOr<DecodedBatch> DecodeBatch(
      const std::string& payload, const VehicleConfig& config) const override;
  absl::StatusOr<DecodedPoses> DecodePoses(
      const std::string& payload, const VehicleConfig& config) const override;
  std::string EncodeDropped(const core::DroppedStretch& stretch) const override;
  absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeMeasurement(
      const std::string& payload, core::StateSpace space) const override;
  absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                         std::size_t first,
                                         std::size_t count) const override;
  std::vector<BatchPart> DivideBatch(std::string payload, std::size_t count,
                                     std::size_t most_bytes) const override;
};

// Sets payload and fingerprints of the batch.
void EncodeBatch(const google::protobuf::RepeatedPtrField<v1::Pose>& poses,
                 DecodedBatch* batch);

// Returns the new pose of a sequence, or null if it stays as it is.
using RevisedPose = std::function<const v1::Pose*(std::uint64_t sequence)>;

// The batch with new estimates; nothing if none of its poses is replaced.
// Stamps stay; so do error transitions where the new pose brings none.
// REQUIRES: CheckRevisedPoses() says OK to the new ones.
absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    const RevisedPose& revised);

// Calls `visit` with each pose of a stored batch, in order, until it says
// false; with none where they were dropped. `visit` may take the pose's
// content.
absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(v1::Pose*)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_RECORD_CODEC_H_
