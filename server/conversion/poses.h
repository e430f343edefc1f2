// Batches of poses as callers send them.
#ifndef REVISIT_SERVER_CONVERSION_POSES_H_
#define REVISIT_SERVER_CONVERSION_POSES_H_

#include <cstddef>
#include <cstdint>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/fields/field_violations.h"
#include "server/sessions/append_request.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/records.h"

namespace revisit::server {

using Poses = google::protobuf::RepeatedPtrField<v1::Pose>;

// The poses of a request, in one of the two forms that there are. It points
// into the request.
struct SentPoses {
  // Never null.
  const Poses* poses;
  // Null if absent.
  const v1::PoseColumns* columns;

  // How many there are in both forms; of columns those that they claim and have
  // places for, so that a caller counts for no more than it has sent.
  std::uint64_t count() const;
};

// Message: one with `poses` and `columns`.
template <typename Message>
SentPoses SentPosesOf(const Message& message) {
  return {&message.poses(),
          message.has_columns() ? &message.columns() : nullptr};
}

// A batch as AppendPoses takes it. The fields `poses` and `columns` lie below
// `path`.
absl::StatusOr<DecodedBatch> DecodeBatch(const SentPoses& sent, int max_poses,
                                         const VehicleConfig& config,
                                         const FieldPath& path);

// DecodeBatch() for when the vehicle's config is known. The poses must stay as
// they are until then; `parent` is the field that they lie below, or null.
BatchDecoder DecoderOf(const SentPoses& sent, int max_poses,
                       const char* parent);

// Drops fields that this version does not know, so that they take no room in
// the draft of a revision. None reaches a record in any case.
void DropUnknownFields(Poses* poses);

// The version of stored poses that a request's field `view` means.
absl::StatusOr<BatchVersion> DecodePoseView(v1::PoseView view);

// Whether poses may replace stored ones. Paths number them over the whole call,
// these from `first_number` on.
absl::Status CheckRevisedPoses(const Poses& poses, std::size_t first_number,
                               const VehicleConfig& config);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSES_H_
