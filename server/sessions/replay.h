// Makes a vehicle's graph from what is stored: when the vehicle is loaded, and
// anew after a change that moves nodes.
#ifndef REVISIT_SERVER_SESSIONS_REPLAY_H_
#define REVISIT_SERVER_SESSIONS_REPLAY_H_

#include <atomic>
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
#include "server/sessions/measured_loops.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// A graph in the making.
struct Replay {
  VehicleConfig config;
  std::uint64_t revision;
  // A load goes only as far as what is stored is sound.
  bool is_load;
  std::function<void(const absl::Status&)> then;
  std::unique_ptr<core::Drive> drive;
  std::vector<core::Jump> jumps;
  // Whether a snapshot may still be looked for.
  bool may_use_snapshot = true;
  // The snapshot that the graph comes from, if any, and the parts of it so far.
  std::optional<SnapshotRecord> snapshot;
  std::uint32_t parts = 0;
  bool has_rest = false;
  std::uint64_t next_sequence = 1;
  // Number of changes made to the drive so far, which serves as its revision
  // during the replay: a drive's revisions have to grow, and those that are
  // stored with the batches need not grow with the sequence once some batches
  // were revised.
  std::uint64_t steps = 0;
  // The highest revision of the batches so far.
  std::uint64_t highest_revision = 0;
  MeasuredLoops measured;
};

// Belongs to the strand, but for GiveUp(). Works in slices of time, so that
// other vehicles get their turn; reads see the old graph until it is done.
class Replayer {
 public:
  Replayer(VehicleState* vehicle, VehicleQueue* queue)
      : vehicle_(vehicle), queue_(queue) {}

  // Loads the vehicle, as far as what is stored is sound; it leaves if it
  // cannot be loaded. First task of the strand.
  void Load();

  // After a change that is stored: makes the graph anew, with this config and
  // revision. A vehicle whose graph cannot be made leaves, since its memory is
  // no longer that of the store. REQUIRES: no append is in flight.
  void Rebuild(const VehicleConfig& config, std::uint64_t revision,
               std::function<void(const absl::Status&)> then);

  // From any thread: a replay that goes on, or begins, ends with UNAVAILABLE
  // (SERVER_DRAINING) if it takes more than a slice of time.
  void GiveUp() { gives_up_ = true; }
  bool gives_up() const { return gives_up_; }

 private:
  absl::Status StartLoad();
  absl::StatusOr<VehicleConfig> StoredConfig(const VehicleRecord& record) const;
  // Reads the pairs of one kind; what was measured of them is decoded once.
  absl::Status LoadPairs(PairKind kind, core::StateSpace space,
                         MeasuredLoops* measured);
  // Reads those that were deleted, which are not kept in memory, to know that
  // they are sound.
  absl::Status LookAtDeletedPairs();
  // Takes a pair, or says what is wrong with it.
  absl::Status TakePair(PairKind kind, core::StateSpace space,
                        const PosePairRecord& pair, MeasuredLoops* measured);
  void TakeUnknown(const VehicleRecord& record, const absl::Status& cause);
  void FinishLoad();
  // Has the store keep that the vehicle is damaged, for those who ask when it
  // is no longer in memory. Nothing but reads starts before that is done.
  void KeepMark();
  // `measured`: those of the loop closures that the vehicle has.
  void Start(VehicleConfig config, std::uint64_t revision, bool is_load,
             MeasuredLoops measured,
             std::function<void(const absl::Status&)> then);
  void Post();
  void Continue();
  void Finish(const absl::Status& status);
  // Goes on for a slice of time. Returns whether all are replayed.
  absl::StatusOr<bool> ReplaySome();
  // `is_time_left` is asked after each that was read.
  absl::StatusOr<bool> ReplayBatches(const std::function<bool()>& is_time_left);
  // Adds a stored batch to the graph. DATA_LOSS if it is not what its row says.
  absl::Status ReplayBatch(const BatchRecord& batch);
  void FindSnapshot();
  // Whether the snapshot is loaded, or was given up.
  bool LoadSnapshot(const std::function<bool()>& is_time_left);
  void DropSnapshot();
  // Begins anew, with the first pose.
  void GiveUpSnapshot(const std::string& cause);
  absl::Status FinishGraph();
  void GoNoFurther(const absl::Status& cause);
  absl::Status CheckPairs();
  absl::Status Damaged(const absl::Status& cause) const;

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  std::optional<Replay> replay_;
  std::atomic<bool> gives_up_{false};
};

// Adds a pair to a graph; of a loop closure, with what was measured, or null.
void AddPair(core::Drive* drive, PairKind kind, const PosePairRecord& pair,
             std::uint64_t revision,
             std::shared_ptr<const core::MeasuredLoop> measured);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_REPLAY_H_
