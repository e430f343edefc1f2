#include "server/sessions/vehicle_view.h"

#include "absl/strings/str_cat.h"
#include "core/drive/dropped_stretch.h"
#include "server/base/status.h"

namespace revisit::server {

using absl::StatusCode;
using absl::StrCat;

std::uint64_t VehicleView::first_kept_sequence() const {
  return drive.dropped().KeptFrom(1);
}

absl::Status PoseNotFound(const std::string& vehicle_id, std::uint64_t sequence,
                          std::uint64_t durable_sequence) {
  const std::string has = durable_sequence == 0
                              ? "it has none yet"
                              : StrCat("it has 1 to ", durable_sequence);
  return Error(StatusCode::kNotFound, "POSE_NOT_FOUND",
               StrCat("vehicle '", vehicle_id, "' has no pose of sequence ",
                      sequence, ", ", has),
               {{"sequence", StrCat(sequence)},
                {"durable_sequence", StrCat(durable_sequence)}});
}

absl::Status PoseDropped(const std::string& vehicle_id, std::uint64_t sequence,
                         std::uint64_t first_kept, std::uint64_t next_kept) {
  return Error(
      StatusCode::kOutOfRange, "POSES_DROPPED",
      StrCat("vehicle '", vehicle_id, "' keeps the pose of sequence ", sequence,
             " no longer (settings.retention): its first is ", first_kept,
             ", and the next after this one ", next_kept),
      {{"sequence", StrCat(sequence)},
       {"first_kept_sequence", StrCat(first_kept)},
       {"next_kept_sequence", StrCat(next_kept)}});
}

absl::Status CheckKept(const VehicleView& view, std::uint64_t sequence) {
  const std::uint64_t next = view.drive.dropped().KeptFrom(sequence);
  if (next == sequence) return absl::OkStatus();
  return PoseDropped(view.id, sequence, view.first_kept_sequence(), next);
}

absl::Status CheckMeant(const std::string& vehicle_id,
                        const VehicleConfig& config,
                        const std::string& expected_uid) {
  if (expected_uid.empty() || expected_uid == config.uid) {
    return absl::OkStatus();
  }
  return Error(
      StatusCode::kFailedPrecondition, "VEHICLE_REPLACED",
      StrCat("vehicle '", vehicle_id, "' has the uid ", config.uid, ", got ",
             expected_uid,
             ": it was made anew, and what was acknowledged was of another "
             "vehicle of this name"),
      {{"vehicle_uid", config.uid}, {"expected_vehicle_uid", expected_uid}});
}

}  // namespace revisit::server
