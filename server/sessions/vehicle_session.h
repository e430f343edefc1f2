// One vehicle in memory: an actor with one ordered queue, which owns the
// engine.
//
// An append is decoded and checked whole, staged, written by the storage, and,
// once durable, applied and acknowledged; then the checks that fell due may
// run. Appends may be in flight one behind the other; every other change waits
// until none is, and holds up those behind it.
//
// A vehicle of which a part is damaged in the store is loaded as far as it is
// sound. It answers reads with that, and every write but AcceptDataLoss() and
// Delete() with DATA_LOSS (STORE_CORRUPT).
//
// All public calls are thread-safe and return at once; callbacks run on the
// threads of the lanes, one at a time for a vehicle, but that Append() may
// decode and stage a batch, or refuse it, before it returns: call it without a
// lock that its callbacks take. Every callback is called exactly once. The
// session's work goes on when the last reference to it is dropped; see fleet.h
// for what must outlive that work.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_SESSION_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_SESSION_H_

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/engine.h"
#include "server/sessions/executor.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

// A batch in core's types, with what is stored of it.
struct DecodedBatch {
  std::vector<core::PoseSample> samples;
  // 64-bit hash of each pose's content, exact to the bit: equal hashes are
  // taken for equal poses.
  std::vector<std::uint64_t> fingerprints;
  // What the storage keeps: the poses as they came.
  std::string payload;
  // Origin that the batch was decoded with, if it is a geodetic vehicle's.
  std::optional<GeodeticOrigin> origin;
};

// Decodes a batch for a vehicle. INVALID_ARGUMENT, with details, for defects.
// Called on the vehicle's strand, since the first batch may set the origin.
using BatchDecoder =
    std::function<absl::StatusOr<DecodedBatch>(const VehicleConfig&)>;

// Knows the bytes in the store. Thread-safe.
class RecordCodec {
 public:
  virtual ~RecordCodec() = default;
  virtual std::string EncodeVehicle(const VehicleConfig& config) const = 0;
  // Of the record only key, id and payload are read. DATA_LOSS if the payload is
  // not what EncodeVehicle makes.
  virtual absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const = 0;
  // DATA_LOSS as above.
  virtual absl::StatusOr<DecodedBatch> DecodeBatch(
      const std::string& payload, const VehicleConfig& config) const = 0;
  // A part of a stored batch: the poses from index `first` on, `count` of them,
  // encoded as a batch of their own.
  virtual absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                                 std::size_t first,
                                                 std::size_t count) const = 0;
};

// What verifiers found, by id.
using PosePairs = std::map<std::string, PosePairRecord>;

// Consistent state of the vehicle, valid during the callback that is given it.
struct VehicleView {
  const std::string& id;
  const VehicleConfig& config;
  const core::Engine& engine;
  VehicleKey key;
  std::uint64_t durable_sequence;
  std::uint64_t revision;
  std::int64_t loop_closure_count;
  const PosePairs* loop_closures = nullptr;
  const PosePairs* rejected_candidates = nullptr;
  // DATA_LOSS (STORE_CORRUPT) if a part of what is stored is damaged: then all
  // else here is what comes before the damage.
  absl::Status damage = absl::OkStatus();
  // Where that is damaged too, the config is none and there are no poses.
  bool config_is_known = true;

  const PosePairs& pairs(PairKind kind) const {
    return kind == PairKind::kLoopClosure ? *loop_closures
                                          : *rejected_candidates;
  }
};

// NOT_FOUND (POSE_NOT_FOUND).
absl::Status PoseNotFound(const std::string& vehicle_id, std::uint64_t sequence,
                          std::uint64_t durable_sequence);

// FAILED_PRECONDITION (VEHICLE_REPLACED) if the caller means a vehicle of
// another uid than the one that has this id; an empty one means any.
absl::Status CheckMeant(const std::string& vehicle_id,
                        const VehicleConfig& config,
                        const std::string& expected_uid);

struct Acknowledgement {
  std::uint64_t durable_sequence = 0;
  std::uint64_t revision = 0;
  std::vector<core::Jump> jumps;
};

// What becomes of one append. The callbacks `durable` come in the order of the
// appends, whatever becomes of each, but for those that are refused with
// QUEUE_FULL: these are answered at once.
struct AppendCallbacks {
  // The decoder has been called or never will be: its message may be reused. OK
  // if the batch was taken on; otherwise `durable` will say the same.
  std::function<void(const absl::Status&)> staged;
  // Durable and applied.
  std::function<void(absl::StatusOr<Acknowledgement>)> durable;
  // Once for each check that fell due, after `durable`; only if `check` is set.
  std::function<void(const VehicleView&, absl::StatusOr<core::CandidateSet>)>
      candidates;
};

// How the checks of an append are run: options for a vehicle of this config.
// INVALID_ARGUMENT if they do not fit it.
using CheckOptions =
    std::function<absl::StatusOr<core::SearchOptions>(const VehicleConfig&)>;

struct AppendRequest {
  BatchDecoder decoder;
  std::optional<CheckOptions> check;
  // Gives up the checks; the append itself is not given up once staged.
  core::ShouldStop should_stop;
  AppendCallbacks callbacks;
};

// Which poses a revision replaces.
struct RevisionPlan {
  // Batches with new payloads: first sequence and count as stored.
  std::vector<BatchRecord> batches;
  std::int64_t revised_count = 0;
  // This revision has done the same before: it is answered again, and nothing
  // is replaced.
  std::optional<std::uint64_t> done_by;
};

// How far a pair's creation time may be moved.
inline constexpr std::int64_t kMostClockError = 3'600'000'000'000;  // An hour.

class VehicleSession {
 public:
  struct Limits {
    // Appends that may wait or be in flight; more are RESOURCE_EXHAUSTED
    // (QUEUE_FULL).
    int max_pending_appends = 256;
    // Pairs of poses of each kind: searches look at all of them.
    std::size_t max_pose_pairs = 100'000;
  };

  // Loads the vehicle on its strand, before anything else it does. If there is
  // no such vehicle all calls answer NOT_FOUND. Two sessions of one vehicle
  // must never be at work at the same time: only the fleet calls this.
  static std::shared_ptr<VehicleSession> Load(std::string id, Storage* storage,
                                              const RecordCodec* codec,
                                              const Lanes& lanes,
                                              const Limits& limits);

  VehicleSession(const VehicleSession&) = delete;
  VehicleSession& operator=(const VehicleSession&) = delete;

  // Reads at one revision: what is durable and applied. What a read has shown,
  // all later ones show as well.
  void Read(std::function<void(absl::StatusOr<VehicleView>)> callback);
  // The same for a callback that searches: it runs where long work does, and
  // holds up this vehicle only.
  void LongRead(std::function<void(absl::StatusOr<VehicleView>)> callback);
  // The same for one that reads the store, as long work: it waits while what is
  // stored is of another revision than the view, which is from when a revision
  // is written until it is applied.
  void ReadStored(std::function<void(absl::StatusOr<VehicleView>)> callback);

  // See AppendCallbacks. Poses that are stored already with the same content
  // are acknowledged again; errors: ALREADY_EXISTS (SEQUENCE_CONTENT_MISMATCH),
  // FAILED_PRECONDITION (SEQUENCE_GAP), DATA_LOSS, RESOURCE_EXHAUSTED
  // (QUEUE_FULL), what the decoder says, what the storage says. If a batch
  // cannot be written, those in flight behind it fail with the same status.
  void Append(AppendRequest request);

  // A client says it holds acknowledgements up to this sequence, of the vehicle
  // of this uid; FAILED_PRECONDITION (VEHICLE_REPLACED) if that is another. If
  // it is more than is durable, answers DATA_LOSS (DURABLE_SEQUENCE_REGRESSED)
  // and, given a uid, puts the vehicle into data loss: a claim without one may
  // be about an earlier vehicle of this name.
  void CheckAcknowledged(
      std::uint64_t acked_sequence, const std::string& vehicle_uid,
      std::function<void(absl::StatusOr<VehicleView>)> callback);

  // Replaces the config by what `change` makes of the current one; the graph is
  // rebuilt where nodes move. `change` may refuse, and must where a vehicle
  // with poses would get another state space or frame, or change to or from the
  // correlation model kFilter.
  void Update(
      std::function<absl::StatusOr<VehicleConfig>(const VehicleView&)> change,
      std::function<void(absl::StatusOr<VehicleView>)> callback);

  // Ends the state of data loss, or gives up what is damaged and all poses after
  // it; FAILED_PRECONDITION (NO_DATA_LOSS) if there is neither,
  // (DURABLE_SEQUENCE_MISMATCH) if the sequence is not the durable one.
  void AcceptDataLoss(
      std::uint64_t durable_sequence,
      std::function<void(absl::StatusOr<VehicleView>)> callback);

  // Revises poses: `plan` reads what is stored and says what to replace, or
  // refuses. Answers the revision and the count of the plan; a plan without
  // batches, or that was done before, changes nothing.
  void Revise(
      std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)> plan,
      std::function<
          void(absl::StatusOr<std::pair<std::uint64_t, std::int64_t>>)>
          callback);

  // Adds what a verifier found; answers the stored pair and the revision. The
  // same id and sequences again: the existing one. Creation times tell the order:
  // one that is not later than all others' is moved behind them. Where that is
  // further than kMostClockError, the clock was wrong before, and the pair goes
  // where its time says. Errors: ALREADY_EXISTS (WordsOf(kind).exists),
  // NOT_FOUND (POSE_NOT_FOUND) if a sequence is not durable,
  // FAILED_PRECONDITION (POSE_PAIR_LIMIT). REQUIRES: 1 <= matched_sequence <
  // query_sequence.
  void AddPosePair(
      PairKind kind, PosePairRecord pair,
      std::function<
          void(absl::StatusOr<std::pair<PosePairRecord, std::uint64_t>>)>
          callback);
  // Answers the revision. NOT_FOUND (WordsOf(kind).not_found) if there is none.
  void DeletePosePair(
      PairKind kind, std::string id,
      std::function<void(absl::StatusOr<std::uint64_t>)> callback);

  // Deletes the vehicle. All later calls answer NOT_FOUND.
  void Delete(std::function<void(absl::Status)> callback);

  // Somebody met damage in what is stored that the session does not know of: it
  // has to be loaded anew to know what is sound.
  void LoadAnew();

  // Ends the session: what was called before is finished, later calls answer
  // UNAVAILABLE (SERVER_DRAINING). When `callback` runs, the session uses
  // neither storage nor codec any more.
  void Close(std::function<void()> callback);

  // Whether every call will answer an error from now on: the vehicle was
  // deleted, could not be loaded, or must be loaded anew since it and the store
  // disagree.
  bool gone() const;

  // What of it is in memory, the graph in the making while it is loaded or
  // rebuilt. Takes no turn in the queue.
  struct Residency {
    std::int64_t nodes = 0;
    // Of nodes and edges.
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
