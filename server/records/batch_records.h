// Batches of poses as bytes (revisit.stored.PoseBatch), beside what sessions
// need of them (proto_record_codec.h).
#ifndef REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_
#define REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/fields/pose_fields.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Writes payload and fingerprints of a batch, a pose after the other.
class BatchWriter {
 public:
  // The bytes that a pose takes in a payload.
  static std::size_t BytesOf(const PoseFields& pose);

  // For so many poses, which take so many bytes together.
  BatchWriter(std::size_t count, std::size_t bytes, DecodedBatch* batch);

  void Add(const PoseFields& pose);

 private:
  DecodedBatch* const batch_;
  std::uint8_t* next_;
};

// Sets payload and fingerprints of the batch. Poses: a repeated field.
template <typename Poses>
void EncodeBatch(const Poses& poses, DecodedBatch* batch) {
  std::size_t bytes = 0;
  for (const auto& pose : poses) {
    bytes += BatchWriter::BytesOf(PoseFieldsOf(pose));
  }
  BatchWriter writer(static_cast<std::size_t>(poses.size()), bytes, batch);
  for (const auto& pose : poses) writer.Add(PoseFieldsOf(pose));
}

// Returns the new pose of a sequence, or nothing if it stays as it is.
using RevisedPose =
    std::function<std::optional<PoseFields>(std::uint64_t sequence)>;

// The batch with new estimates; nothing if none of its poses is replaced.
// Stamps stay; so do error transitions where the new pose brings none.
// REQUIRES: the new poses are valid (PoseDecoder, PoseSource::kRevision).
absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    const RevisedPose& revised);

// Calls `visit` with each pose of a stored batch, in order, until it says
// false; with none where they were dropped. The fields are valid during the
// call.
absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(const PoseFields&)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_
