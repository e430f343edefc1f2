// The contract of the server's storage: the promise that records (records.h)
// are kept.
//
// Writes are asynchronous. Those of a vehicle are committed in the order in
// which they were submitted, many at a time (group commit over all vehicles),
// and `done` is called after the commit has returned: OK means durable. Reads
// block and see every write whose `done` has been called.
//
// Payloads are bytes that the storage does not interpret; it guards each with a
// format version and a checksum, and answers DATA_LOSS for one that fails.
//
// One server writes a vehicle at a time: its owner. Where several servers share
// a storage, a vehicle is theirs in turn: TakeVehicle() makes a server the
// owner, with an epoch that every write of it is compared with in the store, so
// a server that no longer is the owner writes nothing, whatever it believes:
// ABORTED (EPOCH_FENCED). Whoever opened the storage alone owns all vehicles,
// always.
//
// Damage affects its own vehicle only. A damaged record of a vehicle or of a
// pair of poses is returned with `damage` set, beside all others, so that it
// can be reported, given up (DropDamaged()) or deleted.
//
// Groups of vehicles, which no server owns, have a contract of their own
// (group_storage.h).
//
// Every error carries a reason (server/base/status.h). Besides those named at
// each call: UNAVAILABLE (STORE_UNAVAILABLE) where the device or the file
// system fails, DATA_LOSS (STORE_CORRUPT) for damage, NOT_FOUND
// (VEHICLE_NOT_FOUND) for a key without a vehicle. A write that was answered
// with UNAVAILABLE is not visible, but may be after a crash right then, or once
// a connection that broke is found to have been heard; a later write is never
// acknowledged on top of one whose fate is unknown. TakeVehicle() settles it:
// what it answers with is what was written, and nothing of before can come
// after it.
//
// Thread-safe.
#ifndef REVISIT_SERVER_STORAGE_STORAGE_H_
#define REVISIT_SERVER_STORAGE_STORAGE_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/base/histogram.h"
#include "server/storage/group_storage.h"
#include "server/storage/records.h"
#include "server/storage/storage_facts.h"

namespace revisit::server {

// Counts since the storage was opened.
struct CommitCounts {
  // Transactions that were committed, and the writes that they held.
  std::uint64_t commits = 0;
  std::uint64_t writes = 0;
  // Seconds that the transactions took, from the first statement to the last.
  HistogramCounts commit_seconds = {};
  // Seconds until something written was on the device: of each transaction's
  // end, or, where that cannot be told apart, of one small transaction now and
  // then. Nothing where the storage cannot tell.
  HistogramCounts flush_seconds = {};
};

// The room that a storage takes and has left.
struct StorageRoom {
  std::int64_t bytes = 0;
  // Bytes that others than the storage leave free; nothing where the device is
  // another machine's.
  std::optional<std::int64_t> free_bytes = std::nullopt;
  // Below which of these the storage refuses writes.
  std::int64_t min_free_bytes = 0;
};

// This server among those that share a storage.
struct SharingState {
  std::int64_t owned_vehicles = 0;
  // Vehicles that were lost to others rather than handed over, and how often
  // the server was taken for dead.
  std::uint64_t lost_vehicles = 0;
  std::uint64_t lost_leases = 0;
  // Whether the server may answer from memory; see Storage::CheckOwned().
  bool lease_holds = true;
};

// A vehicle that another server asks for.
struct WantedVehicle {
  VehicleKey key = 0;
  std::string id;
};

class Storage {
 public:
  using Done = WriteDone;

  // Commits what was submitted, then stops.
  virtual ~Storage() = default;

  // ALREADY_EXISTS (VEHICLE_EXISTS) if the id is taken. Of the record only id,
  // payload and revision are read.
  virtual void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) = 0;
  // Replaces the payload. In this and all other calls with a revision, the
  // vehicle's revision becomes that one if it is greater.
  virtual void UpdateVehicle(VehicleKey key, std::string payload,
                             std::uint64_t revision, Done done) = 0;
  // Removes the vehicle and all that belongs to it. Of its events, the places
  // stay, without payload, so that who has read up to one can go on behind it;
  // `farewell`, if it has had any, is its last one, whose number is given here.
  // The vehicle leaves its groups, with its links.
  virtual void DeleteVehicle(VehicleKey key, EventRecord farewell,
                             Done done) = 0;
  // Stores batches that follow each other, all in one step.
  // FAILED_PRECONDITION (SEQUENCE_GAP) unless the first follows the last stored
  // one without a gap: what is stored is always a prefix. `vehicle_payload`, if
  // given, replaces the vehicle's in the same step. REQUIRES: at least one
  // batch, counts of at least 1, sequences below 2^63.
  virtual void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                             std::optional<std::string> vehicle_payload,
                             Done done) = 0;
  // The largest payload of a batch that costs no more, byte by byte, than
  // smaller ones do: who has a larger batch had better divide it.
  virtual std::size_t MostBatchBytes() const {
    return std::numeric_limits<std::size_t>::max();
  }
  // Whether batches may hold columns. They may not where servers of the version
  // before, which cannot read these, share the store.
  virtual bool KeepsColumns() const { return true; }
  // Sets the current version of stored batches, all in one step; the records'
  // own revisions are ignored. FAILED_PRECONDITION if one is not stored with
  // this first sequence and count. REQUIRES: the source has the batches ready,
  // because it is called on the writer's thread, for which all writes wait.
  virtual void ReviseBatches(VehicleKey key, BatchSource batches,
                             std::uint64_t revision, Done done) = 0;
  // Puts batches, each of which follows the one before, in the place of all
  // that hold their poses, which are removed with their revised versions. The
  // records' own revisions are stored. FAILED_PRECONDITION unless whole batches
  // hold exactly these poses. Takes as long as these are many. REQUIRES: at
  // least one.
  virtual void ReplaceBatches(VehicleKey key,
                              std::vector<BatchVersions> batches,
                              std::uint64_t revision, Done done) = 0;
  // ALREADY_EXISTS (WordsOf(kind).exists) if the id is taken. In this and in
  // DeletePosePair(), `checks` is what the pair makes of stored candidates, in
  // the same step: see PutChecks().
  virtual void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                           std::optional<ChecksWrite> checks,
                           std::uint64_t revision, Done done) = 0;
  // Removes the pair with the kind and the id of the record, and keeps that
  // record in its place, but for its number: the last kMostDeletedPairs stay,
  // until the vehicle is deleted. NOT_FOUND (WordsOf(kind).not_found) if there
  // is no such pair.
  virtual void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                              std::optional<ChecksWrite> checks,
                              std::uint64_t revision, Done done) = 0;

  // Stores checks and the events that go with them, in one step.
  // FAILED_PRECONDITION (INTERNAL) unless the vehicle's head of checks is
  // `checks.before`. The vehicle's revision stays.
  virtual void PutChecks(VehicleKey key, ChecksWrite checks, Done done) = 0;
  // Removes events that are older than `before_ns`, of all vehicles, the oldest
  // ones first, `most` at a time. Needs no owner. What is still to come is
  // answered by another call.
  virtual void DropEvents(std::int64_t before_ns, int most, Done done) = 0;

  // Gives up damaged rows: removes all poses after `last_sequence`, pairs that
  // name such a pose, and damaged pairs, deleted ones too, checks after it and
  // damaged ones, and links of groups that name such a pose, and sets the
  // payload. No check after it counts as made.
  // FAILED_PRECONDITION unless a batch ends at `last_sequence`, or it is 0.
  virtual void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                           std::string payload, std::uint64_t revision,
                           Done done) = 0;

  // ---- A snapshot of a vehicle saves making again what its poses make. It is
  // a cache: a storage may keep none, as this base does, or lose one at any
  // time. It goes, its parts included, in the same step in which
  // ReviseBatches(), ReplaceBatches() or DropDamaged() change or remove
  // batches, or DeleteVehicle() the vehicle.

  virtual bool KeepsSnapshots() const { return false; }
  // Keeps a part, in the place of the one of that number, if there is one. Part
  // 0 begins anew: the snapshot and all parts before are removed.
  // FAILED_PRECONDITION unless the part before it is kept. Parts are some
  // megabytes at most.
  virtual void PutSnapshotPart(VehicleKey key, std::uint32_t number,
                               std::string part, Done done);
  // Makes parts that are kept the snapshot, in the place of the one before.
  // FAILED_PRECONDITION unless all of them are kept.
  virtual void PutSnapshot(VehicleKey key, SnapshotRecord snapshot, Done done);
  virtual void DropSnapshot(VehicleKey key, Done done);
  // Nothing if there is none; DATA_LOSS (STORE_CORRUPT) if it is damaged.
  virtual absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey /*key*/) {
    return std::optional<SnapshotRecord>();
  }
  // Visits parts [first, end) of the snapshot in order, until `visit` returns
  // false. DATA_LOSS (STORE_CORRUPT) if one is missing or damaged, after those
  // before it.
  virtual absl::Status ReadSnapshotParts(
      VehicleKey /*key*/, std::uint32_t /*first*/, std::uint32_t /*end*/,
      const std::function<bool(absl::string_view)>& /*visit*/) {
    return absl::OkStatus();
  }

  // ---- What searches have learned from the marks of a vehicle
  // (core/search/belief/mark.h), as bytes. It is kept where snapshots are, and
  // goes in the same steps as they do, and where part 0 of one begins anew.

  // In the place of what was kept before. Some ten kilobytes.
  virtual void PutMarks(VehicleKey key, std::string marks, Done done);
  // Nothing if there is none; DATA_LOSS (STORE_CORRUPT) if it is damaged.
  virtual absl::StatusOr<std::optional<std::string>> GetMarks(
      VehicleKey /*key*/) {
    return std::optional<std::string>();
  }

  // Makes this server the owner of the vehicle, and reads it as it is from then
  // on. REQUIRED before any write of the vehicle but its creation, and after
  // one that was answered with UNAVAILABLE or ABORTED. UNAVAILABLE (NOT_OWNER;
  // metadata `owner`: the address of the server that has it, `epoch`) where
  // another server lives that has it; that one is asked to hand it over.
  // NOT_FOUND (VEHICLE_NOT_FOUND) if there is no such vehicle.
  virtual absl::StatusOr<VehicleRecord> TakeVehicle(const std::string& id) {
    return GetVehicle(id);
  }
  // Ends the ownership of a vehicle, if this server has it: others may take it.
  // Best effort: the vehicle is free at the latest when this server ends.
  // REQUIRES: no write of it is under way.
  virtual void ReleaseVehicle(VehicleKey /*key*/) {}
  // OK if nobody but this server can have written the vehicle since it was
  // taken, so that what is in memory is what is stored. ABORTED (EPOCH_FENCED)
  // if it has to be taken anew; UNAVAILABLE (LEASE_STALE) where that is not
  // known now. Reads nothing, so it may be asked for every answer.
  virtual absl::Status CheckOwned(VehicleKey /*key*/) const {
    return absl::OkStatus();
  }
  // OK while this server may answer at all, and take vehicles: UNAVAILABLE
  // (LEASE_STALE) once a shared store has not been reached for so long that
  // others may have taken them. Reads nothing.
  virtual absl::Status CheckLease() const { return absl::OkStatus(); }
  // As CheckOwned(), but asks the store, behind the writes of the vehicle that
  // were submitted before: OK if it holds what the last of them has left. For
  // answers that acknowledge what was acknowledged before, since a store may
  // have lost it meanwhile.
  virtual void ConfirmOwned(VehicleKey key, Done done);
  // Calls `hand_over` with each vehicle that this server has owned for a while
  // and others ask for, as soon as that is known, and again from time to time
  // until ReleaseVehicle() gives it to them. The call comes on a thread of the
  // storage's, which must not be made to wait; it may call the storage, but for
  // this. Takes the place of the one before, which is not called any more once
  // this returns; null ends the calls.
  using HandOver = std::function<void(const WantedVehicle&)>;
  virtual void OnWanted(const HandOver& /*hand_over*/) {}
  // This server sends its callers to others before it ends: vehicles are wanted
  // as soon as others ask for them, however short they were here.
  virtual void Leave() {}

  // NOT_FOUND (VEHICLE_NOT_FOUND) if there is no such vehicle. Needs no owner,
  // as all reads.
  virtual absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) = 0;
  // Those of these vehicles that there are, ordered by id, each as GetVehicle()
  // has it. Costs few trips to the store, however many they are; it may be as
  // of several moments.
  virtual absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) = 0;
  // The vehicles whose ids start with `prefix` and come after `after_id`,
  // ordered by id. Others are not read, so their damage does not matter.
  virtual absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix, int limit) = 0;
  // The rows of vehicles whose keys come after `after_key`, ordered by key, for
  // those who look at all of them: nothing is read but these rows, so only key,
  // id, payload and the damage of the row itself are set.
  virtual absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) = 0;
  // Visits the batches that hold poses of [first_sequence, last_sequence], in
  // order and as of one moment, until `visit` returns false. `visit` may read
  // from the storage. DATA_LOSS if a batch is missing or damaged, after those
  // before it. REQUIRES: the range ends at or before the durable sequence;
  // poses beyond it would look like damage.
  virtual absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version, const std::function<bool(BatchRecord)>& visit) = 0;
  // The pairs whose ids come after `after_id`, ordered by id.
  virtual absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) = 0;
  // The pairs that were deleted and are kept, the last one first.
  virtual absl::StatusOr<std::vector<DeletedPairRecord>> ListDeletedPairs(
      VehicleKey key) = 0;

  // The checks of poses [first_sequence, last_sequence], by sequence;
  // `open_only`: those with open candidates.
  virtual absl::StatusOr<std::vector<CheckRecord>> ListChecks(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      bool open_only, int limit) = 0;
  // The vehicles that owe checks of poses that are stored, by key, from behind
  // `after_key` on, but for those that another server has which lives: it makes
  // them. Only key, id and checks of the records are set.
  virtual absl::StatusOr<std::vector<VehicleRecord>> ListUnchecked(
      VehicleKey after_key, int limit) = 0;
  // The events of all vehicles behind a position, in order: those of a vehicle
  // by number. Nothing can come to stand before what was answered once; so,
  // other than what other reads answer, an event may be answered some time
  // after its write is done, where others write to the store at the same time.
  // Errors:
  // OUT_OF_RANGE (CURSOR_TOO_OLD) if events behind the position were dropped
  // (DropEvents()), (CURSOR_UNKNOWN) if the event that the position names is
  // not there: it is one of another store, or of one that has lost its last
  // writes.
  virtual absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) = 0;
  // The position of the last event that ReadEvents() would answer now.
  virtual absl::StatusOr<EventPosition> LastEvent() = 0;

  // The groups of the vehicles, as long as the storage lives.
  virtual GroupStorage& Groups() = 0;

  // OK if the next write is likely to be taken; otherwise what it would be
  // refused with: RESOURCE_EXHAUSTED (STORAGE_FULL), or UNAVAILABLE
  // (LEASE_STALE) once a shared store has not been reached for the lease. Reads
  // nothing that would make the caller wait. Readiness, the health of writes
  // and the metric revisit_store_writable all are this answer.
  virtual absl::Status CheckWritable() { return absl::OkStatus(); }

  // The servers that share the storage and live, this one among them, by
  // address; none where one server has it alone. Of a server that joined them,
  // the answer is some seconds old at most, and waits for nobody: UNAVAILABLE
  // (LEASE_STALE) where there is none so young.
  virtual absl::StatusOr<std::vector<StorageUser>> ListUsers() {
    return std::vector<StorageUser>();
  }

  // As the store says now: that of a database can change while it is used.
  virtual Durability GetDurability() const { return {}; }

  // Zeros if the implementation does not count.
  virtual CommitCounts Counts() const { return {}; }

  // Waits for nobody: that of a database may be as of a minute ago. Nothing if
  // it is not known.
  virtual std::optional<StorageRoom> GetRoom() const { return std::nullopt; }

  // Nothing where one server has the storage alone.
  virtual std::optional<SharingState> GetSharing() const {
    return std::nullopt;
  }
};

// Values, because implementations keep them.
// NOLINTBEGIN(performance-unnecessary-value-param)
inline void Storage::ConfirmOwned(VehicleKey, Done done) {
  done(absl::OkStatus());
}

inline void Storage::PutSnapshotPart(VehicleKey, std::uint32_t, std::string,
                                     Done done) {
  done(absl::UnimplementedError("no snapshots are kept"));
}

inline void Storage::PutSnapshot(VehicleKey, SnapshotRecord, Done done) {
  done(absl::UnimplementedError("no snapshots are kept"));
}

inline void Storage::DropSnapshot(VehicleKey, Done done) {
  done(absl::OkStatus());
}

inline void Storage::PutMarks(VehicleKey, std::string, Done done) {
  done(absl::UnimplementedError("no marks are kept"));
}
// NOLINTEND(performance-unnecessary-value-param)

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORAGE_H_
