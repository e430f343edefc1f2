// Snapshots of a vehicle's graph (Storage::PutSnapshot()) and the marks beside
// them (Storage::PutMarks()): when they are due, and how they come into the
// store and out of it.
#ifndef REVISIT_SERVER_SESSIONS_SNAPSHOTS_H_
#define REVISIT_SERVER_SESSIONS_SNAPSHOTS_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/search/search.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// ---- The payload of a SnapshotRecord: what the nodes depend on besides poses
// and settings, the jumps, and the rest of the drive.

std::string EncodeSnapshot(const VehicleConfig& config,
                           const std::vector<core::Jump>& jumps,
                           const core::Drive& drive, std::uint32_t parts);
// Loads the rest of a drive that has all parts. False if the payload is
// damaged or of another vehicle: then throw the drive away.
bool DecodeSnapshot(const SnapshotRecord& snapshot, const VehicleConfig& config,
                    std::vector<core::Jump>* jumps, core::Drive* drive);

// The same of marks.
std::string EncodeMarks(const VehicleConfig& config, core::Search* search);
bool DecodeMarks(const std::string& marks, const VehicleConfig& config,
                 core::Search* search);

// Writes snapshots of one vehicle, a part at a time. Belongs to the strand, but
// for what is said to be called from any thread.
class Snapshots {
 public:
  using Clock = std::chrono::steady_clock;

  Snapshots(VehicleState* vehicle, VehicleQueue* queue)
      : vehicle_(vehicle), queue_(queue) {}

  // From any thread: whether as many poses have come since the last snapshot as
  // the policy says.
  bool is_due() const;
  // From any thread: whether the store lacks marks that searches have learned.
  bool has_new_marks() const;
  // From any thread.
  bool is_writing() const { return writing_ > 0; }
  // From any thread. If a snapshot is due: writes up to `most_parts` of the
  // parts that are not yet in the store, and, if none is missing then, the
  // snapshot. Where none is due any more, writes new marks. Stops early where
  // the vehicle may not be written. Then calls `then`, on the strand.
  void Write(int most_parts, std::function<void()> then);
  // From any thread: writes as much of a snapshot that is due as gets into the
  // store until then, and new marks in any case, and calls `then`, on the
  // strand, when no write is under way any more. Write() must not be called
  // after it.
  void Stop(Clock::time_point until, std::function<void()> then);

 private:
  struct Job {
    int parts_left;
    std::function<void()> then;
  };
  using JobPtr = std::shared_ptr<Job>;

  void Step(const JobPtr& job);
  void WriteNext(const JobPtr& job);
  void WritePart(const JobPtr& job);
  void WriteRest(const JobPtr& job);
  void WriteMarks(const JobPtr& job);
  bool MayWrite() const;
  void Fail(const JobPtr& job);
  void End(const JobPtr& job);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  std::atomic<int> writing_{0};
  Clock::time_point until_ = Clock::time_point::max();
  // Called once nothing is written any more.
  std::function<void()> stopped_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_SNAPSHOTS_H_
