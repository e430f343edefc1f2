// Makes a vehicle's graph from what is stored: when the vehicle is loaded, and
// anew after a change that moves nodes.
#ifndef REVISIT_SERVER_SESSIONS_REPLAY_H_
#define REVISIT_SERVER_SESSIONS_REPLAY_H_

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/sessions/drive_replay.h"
#include "server/sessions/measured_loops.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// A graph in the making.
struct Replay {
  DriveReplay drive;
  std::uint64_t revision;
  // A load goes only as far as what is stored is sound.
  bool is_load;
  std::function<void(const absl::Status&)> then;
  // Whether a snapshot may still be looked for.
  bool may_use_snapshot = true;
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
  // Reads those that were deleted, which are not kept in memory, to know that
  // they are sound.
  absl::Status LookAtDeletedPairs();
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
  void FindSnapshot();
  void DropSnapshot();
  // Takes the marks that are stored, if they are of use.
  void TakeMarks();
  absl::Status FinishGraph();
  void GoNoFurther(const absl::Status& cause);
  absl::Status CheckPairs();
  absl::Status Damaged(const absl::Status& cause) const;

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  std::optional<Replay> replay_;
  // Whether the load has dropped the snapshot, and the marks with it.
  bool has_dropped_snapshot_ = false;
  std::atomic<bool> gives_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_REPLAY_H_
