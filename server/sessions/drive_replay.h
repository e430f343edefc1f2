// Makes the drive of a vehicle from what is stored of it: the snapshot, if
// there is one, the batches behind it, and the pairs. The session that has the
// vehicle does so, and so do those who only read it, with the same bits.
#ifndef REVISIT_SERVER_SESSIONS_DRIVE_REPLAY_H_
#define REVISIT_SERVER_SESSIONS_DRIVE_REPLAY_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/drive/findings.h"
#include "core/drive/measured_loop.h"
#include "server/sessions/judged_pairs.h"
#include "server/sessions/measured_loops.h"
#include "server/sessions/vehicle_config.h"
#include "server/sessions/vehicle_reader.h"
#include "server/storage/records.h"

namespace revisit::server {

// What is done with a snapshot that the store has.
struct SnapshotUse {
  bool is_wanted = true;
  // Called, if it is not empty, when one is there and is not used: with the
  // reason, which is empty where it is not wanted.
  std::function<void(const std::string& cause)> left = nullptr;
};

// Thread-compatible.
class DriveReplay {
 public:
  using GoOn = std::function<bool()>;

  // `measured`: those of the loop closures that the vehicle has. The vehicle
  // must outlive this. REQUIRES: core::FindProblems(config.drive) is empty.
  DriveReplay(const VehicleReader* vehicle, VehicleKey key,
              VehicleConfig config, MeasuredLoops measured);

  // Looks for a snapshot; call before the first Continue(), which otherwise
  // begins with the first pose. `last`: the highest sequence stored.
  void FindSnapshot(std::uint64_t last, SnapshotUse use);
  bool has_snapshot() const { return snapshot_.has_value(); }
  // Begins anew, with the first pose.
  void GiveUpSnapshot(const std::string& cause);

  // Goes on, until `go_on`, which is asked after each row that was read, says
  // false. Returns whether all poses up to `last` are in the drive; may be
  // called again with a greater one. DATA_LOSS if a batch is not what its row
  // says; the drive then has all poses before it.
  absl::StatusOr<bool> Continue(std::uint64_t last, const GoOn& go_on);

  // Adds the pairs. REQUIRES: they name poses that are in the drive.
  void AddPairs(const JudgedPairs& pairs);

  // Gives the drive this revision. REQUIRES: greater than steps().
  absl::Status SetRevision(std::uint64_t revision) {
    return drive_->ChangeSettings(config_.drive, revision);
  }

  const VehicleConfig& config() const { return config_; }
  const core::Drive& drive() const { return *drive_; }
  std::uint64_t next_sequence() const { return next_sequence_; }
  // Number of changes made to the drive so far, which serves as its revision
  // during the replay: a drive's revisions have to grow, and those that are
  // stored with the batches need not grow with the sequence once some batches
  // were revised.
  std::uint64_t steps() const { return steps_; }
  // The highest revision of the batches so far.
  std::uint64_t highest_revision() const { return highest_revision_; }
  // Rows of batches that were read.
  std::uint64_t rows() const { return rows_; }
  // The parts of the snapshot that the drive comes from, and its last pose.
  std::uint32_t parts() const { return parts_; }
  std::uint64_t snapshot_sequence() const {
    return snapshot_ ? snapshot_->last_sequence : 0;
  }

  // The drive and its jumps, for who goes on with them; ends the replay.
  std::unique_ptr<core::Drive> TakeDrive() { return std::move(drive_); }
  std::vector<core::Jump> TakeJumps() { return std::move(jumps_); }

 private:
  // Whether the snapshot is loaded, or was given up.
  bool LoadSnapshot(const GoOn& go_on);
  absl::StatusOr<bool> ReplayBatches(std::uint64_t last, const GoOn& go_on);
  absl::Status ReplayBatch(const BatchRecord& batch);

  const VehicleReader* const vehicle_;
  const VehicleKey key_;
  const VehicleConfig config_;
  MeasuredLoops measured_;
  SnapshotUse snapshot_use_;
  std::unique_ptr<core::Drive> drive_;
  std::vector<core::Jump> jumps_;
  // The snapshot that the drive comes from, if any, and the parts of it so far.
  std::optional<SnapshotRecord> snapshot_;
  std::uint32_t parts_ = 0;
  bool has_rest_ = false;
  // Whether the poses of the snapshot that loop closures name were taken.
  bool has_measured_ = false;
  std::uint64_t next_sequence_ = 1;
  std::uint64_t steps_ = 0;
  std::uint64_t highest_revision_ = 0;
  std::uint64_t rows_ = 0;
};

// Reads the pairs of one kind; what was measured of them is decoded once. Calls
// `note_damage` for each that is damaged, and where it cannot go on for damage.
absl::Status ReadPairs(
    const VehicleReader& vehicle, VehicleKey key, PairKind kind,
    core::StateSpace space,
    const std::function<void(const absl::Status&)>& note_damage,
    JudgedPairs* pairs, MeasuredLoops* measured);

// Adds a pair to a graph; of a loop closure, with what was measured, or null.
void AddPair(core::Drive* drive, PairKind kind, const PosePairRecord& pair,
             std::uint64_t revision,
             std::shared_ptr<const core::MeasuredLoop> measured);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_DRIVE_REPLAY_H_
