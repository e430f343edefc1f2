// Which vehicles this server owns, in a database that several servers share.
//
// Two mechanisms, and only the first keeps the data right:
//
// * Every vehicle has a row in `heads` with its owner and an epoch, which each
//   claim raises. A write compares both in the same statement, so a server that
//   is no longer the owner writes nothing, however late it wakes. It compares
//   the vehicle's revision too, which every change raises, so nothing is
//   written to a database that lacks the last of them.
// * Every start of a server has a row in `servers`, with a beat that it raises
//   every two seconds. Whoever sees the same beat for the row's whole lease, on
//   a clock of its own, marks the server dead, for ever: its vehicles may then
//   be claimed. So leases decide when a vehicle may be taken, and for how long
//   its owner may answer from memory: up to a tenth less than the lease after
//   it sent its last beat, in case clocks do not run at the same rate. No
//   clocks of two machines are compared. A server that finds itself dead gives
//   up all vehicles and joins under a new identity.
//
// A claim is committed before the vehicle is read, so nothing of the owner
// before can come after what was read. A write whose fate is unknown ends the
// claim under which it was submitted; the next claim waits for the row that the
// write may still hold.
//
// A database that goes on as another one than before, as after a failover, may
// lack what was committed last. So each new connection asks which one it is
// (DatabaseIdentity), and if that has changed or is not told, all claims end:
// each vehicle is taken anew, and compared with what is in memory, before it is
// used again.
//
// Thread-safe.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_OWNERSHIP_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_OWNERSHIP_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <unordered_map>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/base/histogram.h"
#include "server/storage/postgres/ask_pacing.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/storage.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

struct Claim {
  Uuid owner{};
  std::int64_t epoch = 0;
  // The epoch of this server's claim before, after which nobody else had the
  // vehicle; 0 if there was none, or somebody else had it.
  std::int64_t previous_epoch = 0;
  // When it was made, on the clock of OwnershipOptions.
  std::chrono::nanoseconds since{0};
  std::string vehicle_id;
  // The head's revision after the last write under the claim, or when it was
  // made.
  mutable std::atomic<std::uint64_t> revision{0};
  // Set when the server forgets the claim: what was submitted under it is
  // refused, although the database may still know it.
  mutable std::atomic<bool> has_ended{false};
};

struct OwnershipOptions {
  // The address at which other servers' callers find this one.
  std::string address;
  // How long this server may be silent before others take its vehicles. At
  // least three beats, so that one that is late does no harm.
  std::chrono::milliseconds lease{10'000};
  std::chrono::milliseconds beat_period{2'000};
  // A vehicle stays for so long at least, so that two callers who come to
  // different servers do not have it go to and fro.
  std::chrono::milliseconds least_stay{10'000};
  // A clock that goes on while the machine sleeps; CLOCK_BOOTTIME if empty.
  std::function<std::chrono::nanoseconds()> now;
  // Called with what an operator should know; may be empty.
  std::function<void(const std::string&)> warn;
};

// ABORTED (EPOCH_FENCED).
absl::Status Fenced(const std::string& vehicle);

// The servers of a database that live, for those who have not joined them, by
// address.
absl::StatusOr<std::vector<StorageUser>> ListLivingServers(
    PostgresConnection& connection);

// Which database a connection leads to: its system identifier and its timeline,
// which a promoted standby and a restored backup have anew; empty if the role
// may not ask.
using DatabaseIdentity = std::string;

class Ownership {
 public:
  // Joins the servers of the database, and beats from then on.
  static absl::StatusOr<std::unique_ptr<Ownership>> Join(
      const std::string& conninfo, const OwnershipOptions& options);
  // Leaves, which frees all vehicles at once. If the database does not answer,
  // they are free when the lease has run out.
  ~Ownership();

  Ownership(const Ownership&) = delete;
  Ownership& operator=(const Ownership&) = delete;

  // Claims a vehicle; returns its key. Errors are those of
  // Storage::TakeVehicle().
  absl::StatusOr<VehicleKey> Take(PostgresConnection& connection,
                                  const std::string& id);
  // The claim on a vehicle; null if there is none.
  std::shared_ptr<const Claim> Find(VehicleKey key) const;
  // This server, as the database knows it.
  Uuid Self() const;
  // The highest key of a vehicle that was ever claimed here.
  VehicleKey HighestKey() const;
  // Ends this claim here, not in the database. It is `lost` if the database
  // says that it is another server's.
  void Forget(VehicleKey key, const Claim* claim, bool lost = false);
  // Ends a claim in the database, unless there is a later one. Forget it first.
  static absl::Status Release(PostgresConnection& connection, VehicleKey key,
                              const Uuid& owner, std::int64_t epoch);
  // Implements Storage::CheckOwned().
  absl::Status Check(VehicleKey key) const;
  // Implements Storage::CheckLease().
  absl::Status CheckLease() const;
  // Implements Storage::OnWanted(). What others ask for shows with each beat;
  // the calls come on its thread.
  void OnWanted(Storage::HandOver hand_over);
  // Implements Storage::Leave(). Beats four times as often from then on.
  void Leave();
  // Implements Storage::ListUsers().
  absl::StatusOr<std::vector<StorageUser>> Users() const;

  // As of the last beat.
  Durability durability() const;
  // Implements Storage::GetSharing().
  SharingState GetSharing() const;
  // Seconds that the database took to answer beats. Each is a transaction of
  // one row, so that is the time in which a commit becomes as durable as the
  // database's settings say, and the way there and back.
  HistogramCounts BeatSeconds() const { return beat_seconds_.Read(); }

 private:
  Ownership(const std::string& conninfo, OwnershipOptions options);

  // The last sight of another server: its beat, and since when.
  struct Sighting {
    std::int64_t beat = 0;
    std::chrono::nanoseconds since{0};
  };

  std::chrono::nanoseconds Now() const { return options_.now(); }
  void Warn(const std::string& message) const;
  // The key of a vehicle that was free; nothing if it was not.
  absl::StatusOr<std::optional<VehicleKey>> TryToClaim(
      PostgresConnection& connection, const std::string& id, const Uuid& me);
  // Asks the living server that has it for a vehicle, whose row of kWhoOwns
  // this is; returns NOT_OWNER.
  absl::Status AskFor(PostgresConnection& connection, const std::string& id,
                      const Uuid& me, const PostgresRows& owner);
  bool LeaseHolds() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // A vehicle that is this server's and that others ask for.
  struct Wanted {
    std::string id;
    // Whether `hand_over_` was called with it since the last beat.
    bool is_told = false;
  };
  // How long the vehicle is to stay yet; zero or less if it may go. Nothing if
  // it is this server's no more.
  std::optional<std::chrono::nanoseconds> StayOf(VehicleKey key) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // The thread that beats; it alone uses `connection_`, `database_`,
  // `sightings_`, `forgotten_` and `last_look_`.
  void Run();
  // From a beat to the next one.
  std::chrono::milliseconds BeatPeriod(bool has_failed) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Waits until the next beat is due, or the thread is to stop. Meanwhile
  // vehicles become due that others ask for.
  void AwaitBeat(bool has_failed) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Calls `hand_over_` with the vehicles that are due, without the lock.
  void TellWanted() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // When the next of the wanted vehicles is due; never, if none is.
  std::chrono::steady_clock::time_point NextDue() const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  absl::Status Beat();
  // A row, unless others have taken this server for dead.
  absl::StatusOr<PostgresRows> RaiseBeat(const Uuid& me);
  absl::Status Connect();
  absl::Status Enter();
  // Ends all claims if the database is not known to be the one of before, and
  // otherwise those that it does not know.
  absl::Status ForgetLostClaims();
  absl::StatusOr<DatabaseIdentity> Identify();
  void EndAllClaims(const DatabaseIdentity& before,
                    const DatabaseIdentity& now);
  absl::Status EndUnknownClaims();
  absl::Status BuryOthers(const Uuid& me);
  absl::Status PollHandovers(const Uuid& me);

  const PostgresConnection::Options connection_options_;
  const OwnershipOptions options_;

  std::unique_ptr<PostgresConnection> connection_;
  // The database that the connection before led to.
  DatabaseIdentity database_;
  std::map<Uuid, Sighting> sightings_;
  // Vehicles that others ask for and the database says are of this server,
  // which has no claim on them; and since when that is known.
  std::map<VehicleKey, std::chrono::nanoseconds> forgotten_;
  // When it looked last.
  std::chrono::steady_clock::time_point last_look_;
  Histogram beat_seconds_{SecondsBounds()};

  mutable Mutex mutex_;
  CondVar wake_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  bool ended_ ABSL_GUARDED_BY(mutex_) = false;
  bool leaving_ ABSL_GUARDED_BY(mutex_) = false;
  Uuid me_ ABSL_GUARDED_BY(mutex_){};
  // Identities of this process until now, this one among them.
  std::set<Uuid> selves_ ABSL_GUARDED_BY(mutex_);
  VehicleKey highest_key_ ABSL_GUARDED_BY(mutex_) = 0;
  // When the last beat that succeeded was sent.
  std::chrono::nanoseconds last_beat_ ABSL_GUARDED_BY(mutex_){0};
  std::unordered_map<VehicleKey, std::shared_ptr<const Claim>> claims_
      ABSL_GUARDED_BY(mutex_);
  // Vehicles that are being claimed, which may be so already in the database.
  std::multiset<std::string> being_taken_ ABSL_GUARDED_BY(mutex_);
  std::map<VehicleKey, Wanted> wanted_ ABSL_GUARDED_BY(mutex_);
  Storage::HandOver hand_over_ ABSL_GUARDED_BY(mutex_);
  // Whether the thread that beats is calling it.
  bool is_telling_ ABSL_GUARDED_BY(mutex_) = false;
  AskPacing asks_ ABSL_GUARDED_BY(mutex_);
  Durability durability_ ABSL_GUARDED_BY(mutex_);
  // The other servers that live, as of the last beat.
  std::vector<StorageUser> others_ ABSL_GUARDED_BY(mutex_);
  // See SharingState.
  std::uint64_t lost_vehicles_ ABSL_GUARDED_BY(mutex_) = 0;
  std::uint64_t lost_leases_ ABSL_GUARDED_BY(mutex_) = 0;

  std::atomic<bool> give_up_{false};
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_OWNERSHIP_H_
