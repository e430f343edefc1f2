// Batches of poses as bytes (revisit.stored.PoseBatch), beside what sessions
// need of them (proto_record_codec.h). Poses are stored in the form in which
// they came: as messages (BatchEncoder) or as columns (stored_columns.h).
#ifndef REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_
#define REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/fields/pose_fields.h"
#include "server/records/stored_pose.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Writes poses as the payload of a batch, in two goes: so it takes as many
// bytes as it needs, and a batch with defects is not written at all.
class BatchEncoder {
 public:
  // `count`: how many poses will come.
  explicit BatchEncoder(std::size_t count) { stored_.reserve(count); }

  // Call for each pose of the batch, in order.
  void Measure(const PoseFields& pose);

  // The payload with the poses that were measured: `fields_of(i)` has the
  // fields of one, as DecodePoses() says.
  template <typename FieldsOf>
  std::string Write(FieldsOf fields_of) const {
    std::string payload(bytes_, '\0');
    auto* next = reinterpret_cast<std::uint8_t*>(&payload[0]);
    for (std::size_t i = 0; i < stored_.size(); ++i) {
      next = Add(stored_[i], fields_of(i), next);
    }
    return payload;
  }

 private:
  static std::uint8_t* Add(const StoredPose& stored, const PoseFields& pose,
                           std::uint8_t* next);

  std::vector<StoredPose> stored_;
  std::size_t bytes_ = 0;
};

// Returns the new pose of a sequence, or nothing if it stays as it is.
using RevisedPose =
    std::function<std::optional<PoseFields>(std::uint64_t sequence)>;

// How recordings begin with the poses of a revised batch.
enum class RevisedStarts {
  // The same recordings begin as with the stored poses.
  kStay,
  // The recording of the vehicle's first pose alone begins: all of the new
  // poses are in one frame.
  kFirst,
};

// The batch with new estimates, as messages in any case; nothing if none of its
// poses is replaced.
// Stamps stay; so do error transitions where the new pose brings none.
// REQUIRES: the new poses are valid (PoseDecoder, PoseSource::kRevision).
absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    RevisedStarts starts, const RevisedPose& revised);

// Calls `visit` with each pose of a stored batch, in order, until it says
// false; with none where they were dropped. The fields are valid during the
// call.
absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(const PoseFields&)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_BATCH_RECORDS_H_
