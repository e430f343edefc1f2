// A vehicle as it is durable and applied, for the parts of a session that
// change it. Belongs to the session's strand, but for what is constant or
// atomic.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_

#include <atomic>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/sessions/judged_pairs.h"
#include "server/sessions/loaded_drive.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/server_clock.h"
#include "server/sessions/snapshot_progress.h"
#include "server/sessions/vehicle_census.h"
#include "server/sessions/vehicle_head.h"
#include "server/sessions/vehicle_reader.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

// UNAVAILABLE (SERVER_DRAINING).
absl::Status ShuttingDown();

// The parts keep their own invariants; what concerns several of them, and what
// is said of the vehicle as a whole, is here.
class VehicleState : public VehicleReader {
 public:
  VehicleState(std::string vehicle_id, Storage* vehicle_storage,
               const RecordCodec* record_codec, SnapshotPolicy policy,
               ServerClock server_clock,
               std::shared_ptr<VehicleCensus> vehicle_census)
      : VehicleReader(std::move(vehicle_id), vehicle_storage, record_codec),
        clock(std::move(server_clock)),
        census(std::move(vehicle_census)),
        snapshots(std::move(policy)) {}

  const ServerClock clock;
  // Null if nobody counts.
  const std::shared_ptr<VehicleCensus> census;

  VehicleHead head;
  JudgedPairs pairs;
  SnapshotProgress snapshots;
  LoadedDrive loaded{&snapshots};
  // Whether stored checks are still to be made, for which poses must stay.
  bool owes_checks = false;

  VehicleView View() const;

  // Call after what may have searched the drive.
  void NoteSearched();

  // Tells the census what state the vehicle has now.
  void Report() const;

  // From now on every call is answered with `status`.
  void Leave(const absl::Status& status);
  // The answer to every call, once there is one.
  const std::optional<absl::Status>& gone_status() const {
    return gone_status_;
  }
  // From any thread.
  bool is_gone() const { return is_gone_.load(); }

  // Store and memory may differ: see CheckAgainstStore().
  bool in_doubt() const { return in_doubt_; }
  void Doubt() { in_doubt_ = true; }

  // Call after every write that failed: store and memory may differ, and where
  // another server has had the vehicle, it leaves.
  void NoteFailedWrite(const absl::Status& status);
  // After a failed write, or where the vehicle has to be taken anew: takes it,
  // and is OK if store and memory agree. Where they do not, or another server
  // has it, the vehicle leaves. Reads the store.
  absl::Status CheckAgainstStore();

  // OK if the vehicle takes writes.
  absl::Status Writable() const;

  // Errors about this vehicle. The first is ABORTED (EPOCH_FENCED).
  absl::Status HandedOver() const;
  absl::Status OutOfStep() const;
  absl::Status Regressed(const std::string& cause,
                         ErrorMetadata metadata) const;
  absl::Status DataLoss(const ErrorMetadata& metadata) const;

 private:
  bool Agrees(const VehicleRecord& record) const;

  bool in_doubt_ = false;
  std::optional<absl::Status> gone_status_;
  std::atomic<bool> is_gone_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_
