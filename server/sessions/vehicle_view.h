// A vehicle as its readers see it: consistent, and at one revision.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_VIEW_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_VIEW_H_

#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <string_view>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/search/search.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/records.h"

namespace revisit::server {

// Pairs of poses that verifiers judged, by id.
using PosePairs = std::map<std::string, PosePairRecord>;

// Valid during the callback that is given it.
struct VehicleView {
  const std::string& id;
  const VehicleConfig& config;
  const core::Drive& drive;
  VehicleKey key;
  std::uint64_t durable_sequence;
  std::uint64_t revision;
  std::int64_t loop_closure_count;
  const PosePairs* loop_closures = nullptr;
  const PosePairs* rejected_candidates = nullptr;
  // DATA_LOSS (STORE_CORRUPT) if a part of the stored vehicle is damaged: the
  // rest of this view is then the part before the damage.
  absl::Status damage = absl::OkStatus();
  // False where the stored settings are damaged too: the config is then a
  // default one and there are no poses.
  bool config_is_known = true;
  // Asks the drive, one callback at a time. Never null in a callback.
  core::Search* search = nullptr;
  // See ExportPoseGraphResponse.
  std::string_view nodes_id = {};
  // How far stored checks have come.
  ChecksHead checks = {};

  // Sequence of the first pose that is kept.
  std::uint64_t first_kept_sequence() const;

  const PosePairs& pairs(PairKind kind) const {
    return kind == PairKind::kLoopClosure ? *loop_closures
                                          : *rejected_candidates;
  }
};

using ViewCallback = std::function<void(absl::StatusOr<VehicleView>)>;

// NOT_FOUND (POSE_NOT_FOUND).
absl::Status PoseNotFound(const std::string& vehicle_id, std::uint64_t sequence,
                          std::uint64_t durable_sequence);

// OUT_OF_RANGE (POSES_DROPPED).
absl::Status PoseDropped(const std::string& vehicle_id, std::uint64_t sequence,
                         std::uint64_t first_kept, std::uint64_t next_kept);

// OK if the pose of this sequence was not dropped; OUT_OF_RANGE (POSES_DROPPED)
// with the first sequence that the vehicle keeps, and the next one.
absl::Status CheckKept(const VehicleView& view, std::uint64_t sequence);

// FAILED_PRECONDITION (VEHICLE_REPLACED) if the caller means a vehicle of
// another uid than the one that has this id; an empty uid means any.
absl::Status CheckMeant(const std::string& vehicle_id,
                        const VehicleConfig& config,
                        const std::string& expected_uid);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_VIEW_H_
