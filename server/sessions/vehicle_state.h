// A vehicle as it is durable and applied, for the parts of a session that
// change it. Belongs to the session's strand, but for what is constant or
// atomic.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_

#include <atomic>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/search/search.h"
#include "server/base/status.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/server_clock.h"
#include "server/sessions/vehicle_census.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

// UNAVAILABLE (SERVER_DRAINING).
absl::Status ShuttingDown();

// Graphs of fewer nodes are not worth a look for what to drop.
inline constexpr core::NodeIndex kLeastLookedAt = 1000;

// The least number of nodes above this one at which a graph is looked at for
// what to drop: a tenth more each time, and the same whenever the vehicle was
// loaded.
core::NodeIndex NextLookAt(core::NodeIndex nodes);

// When graphs are kept as snapshots (snapshots.h).
struct SnapshotPolicy {
  // A snapshot is due once so many poses have come since the last one; 0: none
  // is written or used, and those that are there are removed.
  std::uint64_t poses = 0;
  // None is written of a graph that has more nodes for each pose: a snapshot is
  // as large as its nodes, and where many servers read from one store, the
  // poses are read sooner.
  double most_nodes_per_pose = std::numeric_limits<double>::infinity();
  // Called with what an operator should know; may be empty.
  std::function<void(const std::string&)> warn;
};

struct VehicleState {
  VehicleState(std::string vehicle_id, Storage* vehicle_storage,
               const RecordCodec* record_codec, SnapshotPolicy policy,
               ServerClock server_clock,
               std::shared_ptr<VehicleCensus> vehicle_census)
      : id(std::move(vehicle_id)),
        storage(vehicle_storage),
        codec(record_codec),
        snapshot_policy(std::move(policy)),
        clock(std::move(server_clock)),
        census(std::move(vehicle_census)) {}

  const std::string id;
  Storage* const storage;
  const RecordCodec* const codec;
  const SnapshotPolicy snapshot_policy;
  const ServerClock clock;
  // Null if nobody counts.
  const std::shared_ptr<VehicleCensus> census;

  VehicleKey key = 0;
  VehicleConfig config;
  // Null until loaded.
  std::unique_ptr<core::Drive> drive;
  // Grows whenever the drive is another.
  std::uint64_t drive_series = 0;
  // Asks this drive.
  std::unique_ptr<core::Search> search;
  // The jumps of the graph, by sequence.
  std::vector<core::Jump> jumps;
  std::uint64_t durable_sequence = 0;
  std::uint64_t revision = 0;
  // See VehicleRecord.
  std::int64_t epoch = 0;
  PosePairs loop_closures;
  PosePairs rejections;
  // Creation time of the latest pair of either kind.
  std::optional<std::int64_t> latest_pair_ns;
  // See VehicleView. While the vehicle is loaded, the first cause.
  absl::Status damage;
  bool config_is_known = true;

  // Config, sequence and revision that the vehicle will have once all appends
  // that are in flight are durable and applied.
  struct Staged {
    VehicleConfig config;
    std::uint64_t sequence = 0;
    std::uint64_t revision = 0;
  };
  Staged staged;

  // Store and memory may differ: see CheckAgainstStore().
  bool in_doubt = false;

  // The answer to every call from now on, once there is one.
  std::optional<absl::Status> gone_status;
  std::atomic<bool> is_gone{false};
  // The parts of this graph that the store has for snapshots.
  struct KeptSnapshot {
    // core::Drive::StateKey() of the parts.
    std::string state_key;
    std::uint32_t parts = 0;
    // Grows whenever the parts are others, so that an answer of the storage is
    // known to be about these.
    std::uint64_t series = 0;
  };
  KeptSnapshot kept_snapshot;
  // The pose up to which there is a snapshot, or was tried to be.
  std::uint64_t snapshot_sequence = 0;
  std::atomic<std::uint64_t> poses_since_snapshot{0};
  // Nodes with which the graph is looked at for what to drop (retention.h).
  core::NodeIndex look_at_nodes = 0;
  // See VehicleSession::Residency.
  std::atomic<std::int64_t> resident_nodes{0};
  std::atomic<std::int64_t> resident_bytes{0};

  VehicleView View() const;

  // Tells the census what state the vehicle has now.
  void Report() const;

  // Replaces the drive. Retention looks at it once it has grown.
  void Take(std::unique_ptr<core::Drive> another);

  // Takes on a config and a revision that are durable. REQUIRES: no append is
  // in flight.
  void Adopt(const VehicleConfig& new_config, std::uint64_t new_revision);

  PosePairs& Pairs(PairKind kind) {
    return kind == PairKind::kLoopClosure ? loop_closures : rejections;
  }
  // All pairs in the order in which they were added, so that the graph and its
  // consistency come out the same whenever they are made anew.
  std::vector<std::pair<PairKind, const PosePairRecord*>> PairsAsAdded();
  void FindLatestPair();

  // The jumps of [first, last].
  std::vector<core::Jump> JumpsAt(std::uint64_t first,
                                  std::uint64_t last) const;

  // Call after every change of a graph; `in_the_making` is the one that is
  // being rebuilt, if any.
  void NoteResidency(const core::Drive* in_the_making = nullptr);

  // From now on the poses since this one count for the next snapshot.
  void NoteSnapshot(std::uint64_t sequence);

  // From now on every call is answered with `status`.
  void Leave(const absl::Status& status);

  // Call after every write that failed: store and memory may differ, and where
  // another server has had the vehicle, it leaves.
  void NoteFailedWrite(const absl::Status& status);
  // After a failed write, or where the vehicle has to be taken anew: takes it,
  // and is OK if store and memory agree. Where they do not, or another server
  // has it, the vehicle leaves. Reads the store.
  absl::Status CheckAgainstStore();

  // Decodes a stored batch. DATA_LOSS if it is not what its row says.
  absl::StatusOr<DecodedBatch> DecodeStored(
      const BatchRecord& batch, const VehicleConfig& with_config) const;

  // The same without what replays do not need.
  absl::StatusOr<DecodedPoses> DecodeStoredPoses(
      const BatchRecord& batch, const VehicleConfig& with_config) const;

  // OK if the vehicle takes writes.
  absl::Status Writable() const;

  // Errors about this vehicle. The first is ABORTED (EPOCH_FENCED).
  absl::Status HandedOver() const;
  absl::Status OutOfStep() const;
  absl::Status Corrupt(const std::string& cause) const;
  absl::Status HoldsOthers(const BatchRecord& batch) const;
  absl::Status Regressed(const std::string& cause,
                         ErrorMetadata metadata) const;
  absl::Status DataLoss(const ErrorMetadata& metadata) const;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_STATE_H_
