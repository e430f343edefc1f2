// Parses and writes revisit.stored.PoseBatch, for the files of this folder.
#ifndef REVISIT_SERVER_RECORDS_STORED_BATCH_H_
#define REVISIT_SERVER_RECORDS_STORED_BATCH_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/fields/pose_columns.h"
#include "server/fields/pose_fields.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {

// Tag of the length-delimited field `repeated Pose poses = 1` of PoseBatch.
inline constexpr std::uint32_t kPosesTag = (1 << 3) | 2;

// The bytes that a pose of this size takes in a batch.
std::size_t BytesInBatch(std::size_t size);

// Writes what comes before the bytes of a pose; returns where these begin.
std::uint8_t* BeginPose(std::size_t size, std::uint8_t* next);

// DATA_LOSS: the payload is not that of a batch.
absl::Status NotABatch();
absl::Status DoesNotDecode(const absl::Status& cause);
absl::StatusOr<stored::PoseBatch> ParseBatch(const std::string& payload);

// The poses that the message has, which must outlive them. DATA_LOSS unless
// they are columns of one pose or more.
absl::StatusOr<PoseColumns> ColumnsOf(const stored::PoseColumns& message);

// Visits the poses of a batch in order, and in the forms in which it has them:
// calls `messages` with the range [first, end) of those that stand beside each
// other, and `columns` with each PoseColumns. Both may return an error, which
// ends the visit. DATA_LOSS as ColumnsOf() says, and for a batch that has more
// than poses.
template <typename Messages, typename Columns>
absl::Status VisitParts(const stored::PoseBatch& batch, Messages messages,
                        Columns columns) {
  if (batch.has_dropped() && !batch.columns().empty()) return NotABatch();
  int next = 0;
  const auto visit_messages = [&](int end) {
    const int first = std::exchange(next, end);
    return first < end ? messages(first, end) : absl::OkStatus();
  };
  for (const stored::PoseColumns& message : batch.columns()) {
    int end = next;
    while (end < batch.poses_size() &&
           batch.poses(end).sequence() < message.first_sequence()) {
      ++end;
    }
    absl::Status status = visit_messages(end);
    if (!status.ok()) return status;
    absl::StatusOr<PoseColumns> part = ColumnsOf(message);
    if (!part.ok()) return part.status();
    status = columns(&*part);
    if (!status.ok()) return status;
  }
  return visit_messages(batch.poses_size());
}

// Calls `visit` with the fields of each pose, in order, until it says false.
// They are valid during the call. DATA_LOSS as VisitParts() says.
absl::Status VisitFields(const stored::PoseBatch& batch,
                         const std::function<bool(const PoseFields&)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_STORED_BATCH_H_
