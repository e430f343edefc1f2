// One vehicle in memory: an actor with one ordered queue, which owns the
// drive. Its parts: vehicle_queue.h (when what may start), appends.h,
// changes.h (all other writes), replay.h (the graph from the store),
// pose_dropper.h (poses that are kept no longer), and vehicle_state.h, which
// they share.
//
// A vehicle that is damaged in part in the store is loaded as far as it is
// sound. It answers reads with that, and every write but AcceptDataLoss() and
// Delete() with DATA_LOSS (STORE_CORRUPT).
//
// All public calls are thread-safe and return at once. Callbacks run on the
// threads of the lanes, one at a time per vehicle. Exception: Append() may
// decode and stage a batch, or refuse it, on the calling thread before it
// returns, so hold no lock that its callbacks take. Every callback but that of
// Search() is called exactly once. The session's work goes on when the last
// reference to it is dropped; see fleet.h for what must outlive that work.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_SESSION_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_SESSION_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/sessions/append_request.h"
#include "server/sessions/changes.h"
#include "server/sessions/executor.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/retention_monitor.h"
#include "server/sessions/server_clock.h"
#include "server/sessions/stored_checks.h"
#include "server/sessions/vehicle_census.h"
#include "server/sessions/vehicle_state.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

class VehicleSession {
 public:
  struct Limits {
    // Appends that may wait or be in flight; more are RESOURCE_EXHAUSTED
    // (QUEUE_FULL). The server sets its own limit of this name (limits.h).
    int max_pending_appends = std::numeric_limits<int>::max();
    // Pairs of poses of each kind; more are FAILED_PRECONDITION
    // (POSE_PAIR_LIMIT), because every search looks at all of them.
    std::size_t max_pose_pairs = 100'000;
  };

  // Loads the vehicle on its strand, before anything else it does. If there is
  // no such vehicle all calls answer NOT_FOUND. Two sessions of one vehicle
  // must never be at work at the same time: only the fleet calls this.
  static std::shared_ptr<VehicleSession> Load(
      std::string id, Storage* storage, const RecordCodec* codec,
      const Lanes& lanes, const Limits& limits,
      const SnapshotPolicy& snapshots = SnapshotPolicy(),
      std::shared_ptr<RetentionMonitor> retention =
          std::make_shared<RetentionMonitor>(RetentionMonitor::Reports()),
      ServerClock clock = SystemNanoseconds,
      std::shared_ptr<VehicleCensus> census = nullptr,
      const StoredChecksPolicy& checks = StoredChecksPolicy());

  VehicleSession(const VehicleSession&) = delete;
  VehicleSession& operator=(const VehicleSession&) = delete;

  // Reads what is durable and applied, at one revision. A later read shows all
  // that an earlier one has shown.
  void Read(ViewCallback callback);
  // Reads for a callback that takes long: it runs where long work does, and
  // holds up this vehicle only.
  void LongRead(ViewCallback callback);
  // Reads for a callback that reads the store and takes long. It waits while
  // the store may be of another revision than the view, which is from when a
  // revision is written until it is applied.
  void ReadStored(ViewCallback callback);
  // Reads for a callback that searches in turns: it is called until it returns
  // true, which it has to for a status that is not OK. Between two turns other
  // vehicles' searches get theirs, and the vehicle may change, be handed over
  // or leave, but no other search of it begins. `flow` says whose search it is,
  // among those who share the threads of searches.
  using SearchCallback =
      std::function<bool(const absl::StatusOr<VehicleView>&)>;
  void Search(std::string flow, SearchCallback callback);
  // Whether other work of the vehicle waits for such a callback that runs.
  bool is_wanted() const;

  // See AppendRequest and AppendObserver. Poses that are stored already with
  // the same content are acknowledged again. Errors: ALREADY_EXISTS
  // (SEQUENCE_CONTENT_MISMATCH), FAILED_PRECONDITION (SEQUENCE_GAP),
  // (RECORDING_LIMIT) if the vehicle would have too many recordings,
  // (VEHICLE_REPLACED) if another vehicle is meant, DATA_LOSS,
  // RESOURCE_EXHAUSTED (QUEUE_FULL), those of AppendObserver::StillWanted(), of
  // the decoder and of the storage. If a batch cannot be written, those in
  // flight behind it fail with the same status.
  void Append(AppendRequest request, std::shared_ptr<AppendObserver> observer);

  // A client says it holds acknowledgements up to this sequence, of the vehicle
  // of this uid; FAILED_PRECONDITION (VEHICLE_REPLACED) if that is another. If
  // it is more than is durable, answers DATA_LOSS (DURABLE_SEQUENCE_REGRESSED)
  // and, given a uid, puts the vehicle into data loss: a claim without one may
  // be about an earlier vehicle of this name.
  void CheckAcknowledged(std::uint64_t acked_sequence,
                         const std::string& vehicle_uid, ViewCallback callback);

  // Replaces the config by what `change` makes of the current one; the graph is
  // rebuilt where nodes move. `change` may refuse, and must where a vehicle
  // with poses would get another state space or frame, or change to or from the
  // correlation model kFilter. What new settings no longer keep is dropped
  // after the answer (pose_dropper.h).
  void Update(ConfigChange change, ViewCallback callback);

  // Ends the state of data loss, or gives up what is damaged and all poses
  // after it; FAILED_PRECONDITION (NO_DATA_LOSS) if there is neither,
  // (DURABLE_SEQUENCE_MISMATCH) if the sequence is not the durable one.
  void AcceptDataLoss(std::uint64_t durable_sequence, ViewCallback callback);

  // Revises poses: `plan` reads what is stored and says what to replace, or
  // refuses. Answers the revision and the counts of the plan; a plan without
  // batches, or that was done before, changes nothing.
  void Revise(RevisionPlanner plan, RevisionCallback callback);

  // Adds a pair of poses that a verifier judged; answers the stored pair and
  // the revision. The same id and content again: the existing pair. The order
  // of pairs is that of their creation times: one not later than all others' is
  // moved behind them. Where that is further than kMostClockError, the clock
  // was wrong before, and the pair goes where its time says. Errors:
  // ALREADY_EXISTS (WordsOf(kind).exists), NOT_FOUND (POSE_NOT_FOUND) if a
  // sequence is not durable, FAILED_PRECONDITION (POSE_PAIR_LIMIT), or
  // (POSE_PAIR_CONFLICT) if the two poses are a pair of the other kind, those
  // of RecordCodec::DecodeMeasurement(), NOT_FOUND (CHECK_NOT_FOUND) if the
  // candidate that it answers is not stored. Stored candidates that it decides
  // are changed with it (StoredChecks::WithPair()). REQUIRES: 1 <=
  // matched_sequence < query_sequence.
  void AddPosePair(PairKind kind, PosePairRecord pair, PairAnswer answers,
                   PairCallback callback);
  // Answers the revision. The pair is kept among the deleted ones
  // (Storage::DeletePosePair()). NOT_FOUND (WordsOf(kind).not_found) if there
  // is none.
  void DeletePosePair(
      PairKind kind, std::string id, PairDeletion deletion,
      std::function<void(absl::StatusOr<std::uint64_t>)> callback);

  // Goes on with the checks that the vehicle owes, also where a write of them
  // failed, or the vehicle was loaded while nothing could be answered.
  void PayChecks();
  // Has stored checks go on that wait (StoredChecks::GoOn()); whether some do.
  void GoOnWithChecks();
  bool has_waiting_checks() const;
  // Whether the store does not know yet that no check is owed.
  bool has_unsettled_checks() const;
  // Tells it, then calls `then`.
  void SettleChecks(std::function<void()> then);
  // The checks that are owed.
  std::int64_t check_debt() const;

  // Deletes the vehicle. All later calls answer NOT_FOUND.
  void Delete(std::function<void(absl::Status)> callback);

  // Somebody met damage in the stored vehicle that the session does not know
  // of: the vehicle has to be loaded anew to know what is sound.
  void LoadAnew();

  // Calls that wait for the graph to be made from the store are answered with
  // UNAVAILABLE (SERVER_DRAINING), where that takes long. Close() does so too.
  void GiveUpReplay();

  // Ends the session so that another server may have the vehicle: earlier calls
  // are finished, and new marks are written; later calls answer ABORTED
  // (EPOCH_FENCED).
  void HandOver();

  // Whether a snapshot of the graph is due, and whether one is being written.
  bool wants_snapshot() const;
  bool is_writing_snapshot() const;
  // Whether searches have learned from marks what the store lacks.
  bool has_new_marks() const;
  // If a snapshot is due, writes up to so many parts of it, and, once no part
  // is missing, the snapshot; where none is due any more, new marks; then calls
  // `then`.
  void WriteSnapshot(int most_parts, std::function<void()> then);

  // Ends the session: earlier calls are finished, but for those that
  // GiveUpReplay() ends; later calls answer UNAVAILABLE (SERVER_DRAINING). A
  // snapshot that is due is written, as far as that gets until then, and new
  // marks are. When `callback` runs, the session uses neither storage nor codec
  // any more.
  void Close(std::chrono::steady_clock::time_point snapshot_until,
             std::function<void()> callback);

  // Whether the vehicle has come into memory, sound or not.
  bool is_loaded() const;

  // Whether every call will answer an error from now on: the vehicle was
  // deleted, could not be loaded, or must be loaded anew since it and the store
  // disagree.
  bool gone() const;

  // The vehicle's memory, that of a graph in the making included. Takes no turn
  // in the queue.
  struct Residency {
    std::int64_t nodes = 0;
    // Bytes of nodes and edges.
    std::int64_t bytes = 0;
  };
  Residency residency() const;

  // Whether calls wait or are under way. Exact only for the holder of the last
  // reference.
  bool busy() const;

 private:
  struct State;

  explicit VehicleSession(std::shared_ptr<State> state);
  const std::shared_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_SESSION_H_
