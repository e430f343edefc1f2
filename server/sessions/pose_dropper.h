// Drops the poses that a vehicle's settings do not keep
// (core/drive/retention.h): when that is due, and how they leave the store and
// the graph.
#ifndef REVISIT_SERVER_SESSIONS_POSE_DROPPER_H_
#define REVISIT_SERVER_SESSIONS_POSE_DROPPER_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/node_index.h"
#include "core/drive/retention.h"
#include "core/geometry/pose.h"
#include "server/sessions/replay.h"
#include "server/sessions/retention_monitor.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// Looks when the graph has grown by a tenth, and drops what is at least a tenth
// of it: so what a vehicle has stays below 1.25 times what its settings keep,
// and each pose is dropped, and the graph made anew, for few others. It looks
// for a slice of time, then lets others of the strand run: appends, searches
// and changes go on meanwhile. Where the settings or the graph are others than
// it began with, it begins anew.
//
// Whole rows of the store are dropped, and none that holds a pose to which a
// loop closure refers, of the vehicle or of a group (linked_poses.h); a long
// row that is to go in part is divided before. The stretches that are dropped
// become one row each, a part at a time, each of which leaves a sound store;
// then the graph is made anew by the replay of a load, so it is the one that a
// load makes.
//
// While checks are owed that are to be stored, nothing is dropped: they need
// the poses.
//
// The loop closures of groups are read right before poses are dropped. Where
// they cannot be read, or one is damaged, nothing is dropped, since a pose that
// is gone does not come back: once the damaged one is deleted, the next look
// drops. One that comes to the group while poses are dropped may come too late.
//
// Stamps that are too far ahead of the server's clock do not count
// (server_clock.h).
//
// Belongs to the strand. While poses are dropped, appends wait, and reads of
// memory go on, but not those of the store.
class PoseDropper {
 public:
  PoseDropper(VehicleState* vehicle, VehicleQueue* queue, Replayer* replayer,
              std::shared_ptr<RetentionMonitor> monitor)
      : vehicle_(vehicle),
        queue_(queue),
        replayer_(replayer),
        monitor_(std::move(monitor)) {}
  ~PoseDropper() { End(); }

  PoseDropper(const PoseDropper&) = delete;
  PoseDropper& operator=(const PoseDropper&) = delete;

  // Call after every append, and after the settings have changed: looks if it
  // is time.
  void Consider();
  // Call after a load: looks if a tenth of the nodes is too old, which is seen
  // at once, so that a look that was interrupted is made up for. Whether passes
  // are too many is seen when the graph has grown: a look at each load would
  // take longer than the load.
  void ConsiderLoaded();

 private:
  // The rows of one stretch, as far as they are read.
  struct Stretch {
    core::DroppedStretchMaker maker;
    std::uint64_t first_sequence = 0;
    std::uint64_t count = 0;
    // Rows that are not yet merged with those before them.
    std::size_t rows = 0;
    // Whether a row among those is not dropped yet.
    bool has_poses = false;
  };
  struct Work {
    std::vector<core::SequenceRange> ranges;
    // The poses of loop closures, also of groups, sorted.
    std::vector<std::uint64_t> referred;
    std::size_t range = 0;
    // The next row of the range begins here; 0 before its first row.
    std::uint64_t next_sequence = 0;
    // The last pose of the row before it, if that has poses.
    std::optional<core::Pose> before;
    std::optional<Stretch> stretch;
    // Rows to be written in the place of others; empty if there are none.
    std::vector<BatchVersions> rows;
    // The revision of the last write that was made; 0: nothing was written.
    std::uint64_t revision = 0;
    std::chrono::steady_clock::time_point start;
    // Poses that had been dropped before.
    std::uint64_t dropped_before = 0;
    // Nodes that are to go, by the rule.
    core::NodeIndex nodes_too_old = 0;
    core::NodeIndex nodes_covered = 0;
  };

  void BeginLook();
  void LookSome();
  // Whether what is found is what would be found now.
  bool IsCurrent() const;
  void BeginAnew();
  void End();
  void Drop(const absl::Status& status);
  // Sets Work::ranges; to none where nothing is to go.
  void FindRanges();
  // The ends of all loops, with the poses of those of groups.
  std::vector<core::NodeIndex> LoopEnds(
      const std::vector<std::uint64_t>& linked) const;
  void Step();
  // Reads rows until one is to be written, or for a slice of time. Returns
  // whether all are read.
  absl::StatusOr<bool> ReadSome();
  // Takes the next row of the store. Returns whether more may be taken before a
  // write.
  absl::StatusOr<bool> TakeRow(const BatchRecord& row);
  // Makes the row a part of the stretch, which it may begin.
  void Join(const BatchRecord& row, const DecodedPoses& poses);
  bool MayDrop(const BatchRecord& row) const;
  // Sets Work::rows to the parts of a row of which a part is to go, if that is
  // worth it.
  absl::Status Divide(const BatchRecord& row);
  // A row as it was sent, beside this current version where that is another.
  absl::StatusOr<BatchVersions> ReadVersions(const BatchRecord& current) const;
  absl::StatusOr<BatchRecord> PartOf(const BatchRecord& row,
                                     std::uint64_t first,
                                     std::uint64_t count) const;
  // Sets Work::rows to what is there of the stretch, if any of it is new.
  // `next`: the pose behind it, if that is kept or not dropped yet.
  void Complete(const std::optional<core::Pose>& next, bool is_end);
  void Write();
  void Finish();
  void Report(const Work& work) const;
  // That of the next write.
  std::uint64_t NextRevision() const;

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  Replayer* const replayer_;
  const std::shared_ptr<RetentionMonitor> monitor_;
  // From the begin of a look to the end of what follows from it.
  bool is_under_way_ = false;
  // While it looks.
  std::unique_ptr<core::DroppableSearch> search_;
  // LoadedDrive::series() of the search.
  std::uint64_t drive_series_ = 0;
  // While it drops.
  std::unique_ptr<Work> work_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_POSE_DROPPER_H_
