#include "server/storage/postgres/ownership.h"

#include <pthread.h>
#include <time.h>

#include <algorithm>
#include <optional>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;

// How long the end of the server waits for the database.
constexpr milliseconds kGoodbye{2'000};

// A beat may be late by this much on a machine that is busy.
constexpr milliseconds kLeastGap{2'000};

// How often a vehicle is claimed that was another server's when it was claimed,
// and free when its owner was looked up.
constexpr int kMostClaims = 5;

constexpr Statement kEnter = {
    "enter",
    "INSERT INTO servers (incarnation, address, lease_ms, state) "
    "VALUES (gen_random_uuid(), $1::text, $2::int8, 'live') "
    "RETURNING incarnation"};
// Rows of the dead are of use only to people, who ask who had a vehicle.
constexpr Statement kForgetDead = {
    "forget_dead",
    "DELETE FROM servers WHERE state = 'dead' AND "
    "started_at < now() - interval '30 days'"};
// Brings how many vehicles the server owns: to count them in `heads` is to read
// all of them, however many servers there are.
constexpr Statement kBeat = {
    "beat",
    "UPDATE servers SET beat = beat + 1, vehicles = $2::int8 "
    "WHERE incarnation = $1::uuid AND state = 'live' RETURNING beat"};
constexpr Statement kLeave = {
    "leave", "UPDATE servers SET state = 'dead' WHERE incarnation = $1::uuid"};
constexpr Statement kOthers = {
    "others",
    "SELECT incarnation, beat, lease_ms, address, vehicles "
    "FROM servers WHERE state = 'live' AND incarnation <> $1::uuid"};
constexpr Statement kBury = {
    "bury",
    "UPDATE servers SET state = 'dead' WHERE incarnation = $1::uuid AND "
    "beat = $2::int8 AND state = 'live' RETURNING incarnation"};

// Who may claim is decided as of one moment, and the epoch shows whether that
// still holds when the row's lock was had: a condition on the owner, evaluated
// anew against a row that has changed meanwhile, would miss the row of a server
// that joined after that moment.
constexpr Statement kClaim = {
    "claim",
    "WITH free AS MATERIALIZED ("
    "SELECT h.key, h.epoch, h.owner FROM vehicles v "
    "JOIN heads h ON h.key = v.key "
    "WHERE v.id = $1::text AND (h.owner IS NULL OR h.owner = $2::uuid OR "
    "NOT EXISTS (SELECT 1 FROM servers s WHERE s.incarnation = h.owner AND "
    "s.state = 'live')) AND EXISTS (SELECT 1 FROM servers m WHERE "
    "m.incarnation = $2::uuid AND m.state = 'live')), "
    "asked AS (DELETE FROM handovers o USING free WHERE o.key = free.key) "
    "UPDATE heads h SET owner = $2::uuid, epoch = h.epoch + 1 FROM free "
    "WHERE h.key = free.key AND h.epoch = free.epoch "
    "RETURNING h.key, h.epoch, h.revision, free.owner"};
constexpr Statement kWhoOwns = {
    "who_owns",
    "SELECT v.key, h.owner, h.epoch, s.address, s.state = 'live' "
    "FROM vehicles v LEFT JOIN heads h ON h.key = v.key "
    "LEFT JOIN servers s ON s.incarnation = h.owner WHERE v.id = $1::text"};
// A head that was lost comes back as that of a vehicle without poses: where
// there are some the two disagree, so the vehicle is damaged until an operator
// accepts the loss or deletes it.
constexpr Statement kMakeHead = {
    "make_head",
    "INSERT INTO heads (key, revision) SELECT v.key, greatest(v.revision, "
    "(SELECT b.revision FROM batches b WHERE b.vehicle_key = v.key "
    "ORDER BY b.first_sequence DESC LIMIT 1)) FROM vehicles v "
    "WHERE v.id = $1::text ON CONFLICT (key) DO NOTHING"};
constexpr Statement kAsk = {
    "ask",
    "INSERT INTO handovers (key, owner, asked_by) "
    "VALUES ($1::int8, $2::uuid, $3::uuid) ON CONFLICT (key) DO UPDATE "
    "SET owner = excluded.owner, asked_by = excluded.asked_by "
    "WHERE handovers.owner <> excluded.owner"};
constexpr Statement kHandovers = {
    "handovers",
    "SELECT h.key, v.id, h.epoch FROM handovers o "
    "JOIN heads h ON h.key = o.key AND h.owner = o.owner "
    "JOIN vehicles v ON v.key = h.key WHERE o.owner = $1::uuid"};
constexpr Statement kRelease = {
    "release",
    "WITH r AS (UPDATE heads SET owner = NULL WHERE key = $1::int8 AND "
    "owner = $2::uuid AND epoch = $3::int8 RETURNING key) "
    "DELETE FROM handovers o USING r WHERE o.key = r.key"};
constexpr Statement kLivingServers = {
    "living_servers",
    "SELECT address, vehicles FROM servers WHERE state = 'live' "
    "ORDER BY address"};
constexpr Statement kOwners = {"owners",
                               "SELECT key, owner, epoch, revision FROM heads "
                               "WHERE key = ANY($1::int8[])"};
// Any role may ask this, unless somebody has taken the right from all. The
// timeline is that of the log that is being written; the one in the last
// checkpoint may be older for minutes after a promotion.
constexpr Statement kIdentify = {
    "identify",
    "SELECT system_identifier::text || ', timeline ' || "
    "substr(pg_walfile_name(pg_current_wal_lsn()), 1, 8) "
    "FROM pg_control_system()"};

nanoseconds BootTime() {
  timespec time{};
  clock_gettime(CLOCK_BOOTTIME, &time);
  return std::chrono::seconds(time.tv_sec) + nanoseconds(time.tv_nsec);
}

absl::Status LeaseStale() {
  return Error(StatusCode::kUnavailable, "LEASE_STALE",
               "this server has not reached the database for so long that "
               "another one may have taken its vehicles");
}

absl::Status NotOwner(const std::string& id, const std::string& address,
                      std::int64_t epoch) {
  return Error(StatusCode::kUnavailable, "NOT_OWNER",
               "vehicle '" + id + "' is with the server at " + address,
               {{"owner", address}, {"epoch", std::to_string(epoch)}});
}

}  // namespace

absl::Status Fenced(const std::string& vehicle) {
  return Error(StatusCode::kAborted, "EPOCH_FENCED",
               "nothing was written: this server does not own " + vehicle +
                   " any more, or has to take it anew");
}

absl::StatusOr<std::vector<StorageUser>> ListLivingServers(
    PostgresConnection& connection) {
  const auto rows = connection.Run(kLivingServers);
  if (!rows.ok()) return rows.status();
  std::vector<StorageUser> servers;
  for (int i = 0; i < rows->size(); ++i) {
    servers.push_back({rows->Bytes(i, 0), rows->Integer(i, 1)});
  }
  return servers;
}

Ownership::Ownership(const std::string& conninfo, OwnershipOptions options)
    : connection_options_{conninfo, /*writes=*/true, &give_up_},
      options_(std::move(options)),
      asks_(2 * options_.beat_period,
            options_.least_stay + 2 * options_.beat_period) {}

absl::StatusOr<std::unique_ptr<Ownership>> Ownership::Join(
    const std::string& conninfo, const OwnershipOptions& options) {
  OwnershipOptions complete = options;
  if (!complete.now) complete.now = BootTime;
  std::unique_ptr<Ownership> ownership(
      new Ownership(conninfo, std::move(complete)));
  absl::Status status = ownership->Connect();
  if (status.ok()) status = ownership->Enter();
  if (!status.ok()) return status;
  Uuid me;
  {
    const MutexLock lock(&ownership->mutex_);
    me = ownership->me_;
  }
  // Users() needs to know the others from the start.
  status = ownership->BuryOthers(me);
  if (!status.ok()) return status;
  ownership->connection_->Run(kForgetDead).IgnoreError();
  ownership->thread_ = std::thread([raw = ownership.get()] { raw->Run(); });
  pthread_setname_np(ownership->thread_.native_handle(), "store-beat");
  return ownership;
}

Ownership::~Ownership() {
  if (!thread_.joinable()) return;
  Uuid me;
  {
    const MutexLock lock(&mutex_);
    stopping_ = true;
    wake_.NotifyAll();
    const auto latest = std::chrono::steady_clock::now() + kGoodbye;
    while (!ended_) {
      if (wake_.WaitUntil(&mutex_, latest)) break;
    }
    if (!ended_) give_up_ = true;
    me = me_;
  }
  thread_.join();
  if (connection_ != nullptr && connection_->IsAlive()) {
    connection_->Run(kLeave, Parameters().Add(me)).IgnoreError();
  }
}

void Ownership::Warn(const std::string& message) const {
  if (options_.warn) options_.warn(message);
}

bool Ownership::LeaseHolds() const {
  return Now() < last_beat_ + options_.lease - options_.lease / 10;
}

void Ownership::Run() {
  bool failed = false;
  mutex_.Lock();
  while (!stopping_) {
    AwaitBeat(failed);
    if (stopping_) break;
    mutex_.Unlock();
    const absl::Status status = Beat();
    if (!status.ok() && !failed) {
      Warn("cannot renew the lease: " + std::string(status.message()));
    }
    failed = !status.ok();
    mutex_.Lock();
  }
  ended_ = true;
  wake_.NotifyAll();
  mutex_.Unlock();
}

milliseconds Ownership::BeatPeriod(bool has_failed) const {
  // One that failed is tried again soon: the lease is running out. So is one
  // that was answered so late that it does not renew the lease. Callers of a
  // server that leaves wait for what others ask for.
  const bool is_urgent = has_failed || !LeaseHolds() || leaving_;
  return is_urgent ? options_.beat_period / 4 : options_.beat_period;
}

void Ownership::AwaitBeat(bool has_failed) {
  using Clock = std::chrono::steady_clock;
  const Clock::time_point last = Clock::now();
  while (!stopping_ && Clock::now() < last + BeatPeriod(has_failed)) {
    TellWanted();
    if (stopping_) break;
    wake_.WaitUntil(&mutex_, std::min<Clock::time_point>(
                                 last + BeatPeriod(has_failed), NextDue()));
  }
}

void Ownership::TellWanted() {
  if (!hand_over_) return;
  std::vector<WantedVehicle> due;
  for (auto& [key, wanted] : wanted_) {
    const std::optional<nanoseconds> stay = StayOf(key);
    if (wanted.is_told || !stay || *stay > nanoseconds(0)) continue;
    wanted.is_told = true;
    due.push_back({key, wanted.id});
  }
  if (due.empty()) return;
  const Storage::HandOver hand_over = hand_over_;
  is_telling_ = true;
  mutex_.Unlock();
  for (const WantedVehicle& vehicle : due) hand_over(vehicle);
  mutex_.Lock();
  is_telling_ = false;
  wake_.NotifyAll();
}

std::chrono::steady_clock::time_point Ownership::NextDue() const {
  auto next = std::chrono::steady_clock::time_point::max();
  if (!hand_over_) return next;
  const auto now = std::chrono::steady_clock::now();
  for (const auto& [key, wanted] : wanted_) {
    const std::optional<nanoseconds> stay = StayOf(key);
    if (!wanted.is_told && stay) next = std::min(next, now + *stay);
  }
  return next;
}

std::optional<nanoseconds> Ownership::StayOf(VehicleKey key) const {
  const auto claim = claims_.find(key);
  if (claim == claims_.end()) return std::nullopt;
  if (leaving_) return nanoseconds(0);
  return claim->second->since + options_.least_stay - Now();
}

absl::Status Ownership::Connect() {
  auto connection = PostgresConnection::Open(connection_options_);
  if (!connection.ok()) return connection.status();
  connection_ = *std::move(connection);
  // After a failover to a database that lacks the last commits, claims may be
  // gone with them.
  return ForgetLostClaims();
}

absl::Status Ownership::Enter() {
  const nanoseconds sent = Now();
  const auto rows = connection_->Run(
      kEnter,
      Parameters().AddText(options_.address).Add(options_.lease.count()));
  if (!rows.ok()) return rows.status();
  const MutexLock lock(&mutex_);
  me_ = rows->GetUuid(0, 0);
  selves_.insert(me_);
  last_beat_ = sent;
  durability_ = connection_->durability();
  return absl::OkStatus();
}

absl::Status Ownership::ForgetLostClaims() {
  const absl::StatusOr<DatabaseIdentity> identity = Identify();
  absl::Status status = identity.status();
  if (status.ok()) {
    const DatabaseIdentity before = std::exchange(database_, *identity);
    if (identity->empty() || *identity != before) {
      EndAllClaims(before, *identity);
    } else {
      status = EndUnknownClaims();
    }
  }
  if (!status.ok()) connection_.reset();
  return status;
}

absl::StatusOr<DatabaseIdentity> Ownership::Identify() {
  const auto rows = connection_->Run(kIdentify);
  if (rows.ok()) return rows->Bytes(0, 0);
  // One that answers does not tell.
  if (connection_->IsAlive()) return DatabaseIdentity();
  return rows.status();
}

void Ownership::EndAllClaims(const DatabaseIdentity& before,
                             const DatabaseIdentity& now) {
  std::size_t ended = 0;
  {
    const MutexLock lock(&mutex_);
    ended = claims_.size();
    claims_.clear();
    wanted_.clear();
  }
  if (ended == 0) return;
  Warn(now.empty()
           ? "the database does not tell this role which one it is "
             "(pg_control_system, pg_walfile_name): after each connection that "
             "was lost, all vehicles are taken anew"
           : "the database is another one than before, which may lack what was "
             "committed last: system " +
                 now + ", before " + before + "; all " + std::to_string(ended) +
                 " vehicles are taken anew");
}

absl::Status Ownership::EndUnknownClaims() {
  // Each head is at this revision at least when the database is asked.
  std::map<VehicleKey, std::uint64_t> revisions;
  std::vector<std::int64_t> keys;
  {
    const MutexLock lock(&mutex_);
    for (const auto& [key, claim] : claims_) {
      keys.push_back(key);
      revisions[key] = claim->revision;
    }
  }
  if (keys.empty()) return absl::OkStatus();
  const auto rows = connection_->Run(kOwners, Parameters().Add(keys));
  if (!rows.ok()) return rows.status();
  std::map<VehicleKey, int> found;
  for (int i = 0; i < rows->size(); ++i) found[rows->Integer(i, 0)] = i;
  const MutexLock lock(&mutex_);
  for (const std::int64_t key : keys) {
    const auto claim = claims_.find(key);
    if (claim == claims_.end()) continue;
    const auto row = found.find(key);
    // One of a later epoch was made meanwhile.
    if (row == found.end() ||
        rows->GetUuid(row->second, 1) != claim->second->owner ||
        rows->Integer(row->second, 2) < claim->second->epoch ||
        Unsigned(rows->Integer(row->second, 3)) < revisions[key]) {
      claim->second->has_ended = true;
      claims_.erase(claim);
      ++lost_vehicles_;
    }
  }
  return absl::OkStatus();
}

absl::Status Ownership::Beat() {
  if (connection_ == nullptr || !connection_->IsAlive()) {
    connection_.reset();
    if (absl::Status status = Connect(); !status.ok()) return status;
  }
  Uuid me;
  {
    const MutexLock lock(&mutex_);
    me = me_;
  }
  const nanoseconds sent = Now();
  const auto start = std::chrono::steady_clock::now();
  const auto beat = RaiseBeat(me);
  if (!beat.ok()) return beat.status();
  beat_seconds_.Observe(std::chrono::steady_clock::now() - start);
  if (beat->size() == 0) {
    Warn(
        "other servers have taken this one for dead, and may have taken its "
        "vehicles: it gives up all and goes on under a new identity");
    {
      const MutexLock lock(&mutex_);
      lost_vehicles_ += claims_.size();
      ++lost_leases_;
      claims_.clear();
      wanted_.clear();
    }
    sightings_.clear();
    return Enter();
  }
  if (absl::Status status = connection_->ReadDurability(); !status.ok()) {
    return status;
  }
  {
    const MutexLock lock(&mutex_);
    last_beat_ = sent;
    durability_ = connection_->durability();
  }
  absl::Status status = BuryOthers(me);
  if (status.ok()) status = PollHandovers(me);
  return status;
}

absl::StatusOr<PostgresRows> Ownership::RaiseBeat(const Uuid& me) {
  Parameters parameters;
  parameters.Add(me);
  {
    const MutexLock lock(&mutex_);
    parameters.Add(static_cast<std::int64_t>(claims_.size()));
  }
  return connection_->Run(kBeat, parameters);
}

absl::Status Ownership::BuryOthers(const Uuid& me) {
  const auto rows = connection_->Run(kOthers, Parameters().Add(me));
  if (!rows.ok()) return rows.status();
  const auto look = std::chrono::steady_clock::now();
  // What kept this server from looking, such as a database that was away, may
  // have kept the others from beating: each has its lease from now on.
  if (look - last_look_ > std::max(2 * options_.beat_period, kLeastGap)) {
    sightings_.clear();
  }
  last_look_ = look;
  // Later than any beat that was seen.
  const nanoseconds now = Now();
  std::map<Uuid, Sighting> seen;
  std::vector<StorageUser> living;
  for (int i = 0; i < rows->size(); ++i) {
    const Uuid other = rows->GetUuid(i, 0);
    const std::int64_t beat = rows->Integer(i, 1);
    const milliseconds lease(rows->Integer(i, 2));
    const auto before = sightings_.find(other);
    Sighting sighting = {beat, now};
    if (before != sightings_.end() && before->second.beat == beat) {
      sighting = before->second;
    }
    if (now - sighting.since >= lease) {
      const auto buried =
          connection_->Run(kBury, Parameters().Add(other).Add(beat));
      if (!buried.ok()) return buried.status();
      if (buried->size() > 0) {
        Warn("the server at " + rows->Bytes(i, 3) + " (" + ToText(other) +
             ") was silent for its lease of " + std::to_string(lease.count()) +
             " ms: its vehicles are free");
      }
      continue;
    }
    seen[other] = sighting;
    living.push_back({rows->Bytes(i, 3), rows->Integer(i, 4)});
  }
  sightings_ = std::move(seen);
  const MutexLock lock(&mutex_);
  others_ = std::move(living);
  return absl::OkStatus();
}

absl::Status Ownership::PollHandovers(const Uuid& me) {
  const auto rows = connection_->Run(kHandovers, Parameters().Add(me));
  if (!rows.ok()) return rows.status();
  std::map<VehicleKey, Wanted> wanted;
  std::map<VehicleKey, nanoseconds> forgotten;
  std::vector<std::pair<VehicleKey, std::int64_t>> unused;
  const nanoseconds now = Now();
  {
    const MutexLock lock(&mutex_);
    for (int i = 0; i < rows->size(); ++i) {
      const VehicleKey key = rows->Integer(i, 0);
      const std::string id = rows->Bytes(i, 1);
      if (claims_.count(key) > 0) {
        wanted[key].id = id;
      } else if (being_taken_.count(id) == 0) {
        // A write was in doubt, after which this server may take it again, or
        // a release did not come through. When it came is not known any more.
        const auto known = forgotten_.find(key);
        const nanoseconds since =
            known == forgotten_.end() ? now : known->second;
        forgotten[key] = since;
        if (now - since >= options_.least_stay) {
          unused.emplace_back(key, rows->Integer(i, 2));
        }
      }
    }
    wanted_ = std::move(wanted);
  }
  forgotten_ = std::move(forgotten);
  for (const auto& [key, epoch] : unused) {
    const absl::Status released = Release(*connection_, key, me, epoch);
    if (!released.ok()) return released;
  }
  return absl::OkStatus();
}

absl::StatusOr<VehicleKey> Ownership::Take(PostgresConnection& connection,
                                           const std::string& id) {
  Uuid me;
  {
    const MutexLock lock(&mutex_);
    if (!LeaseHolds()) return LeaseStale();
    me = me_;
  }
  for (int attempt = 1; attempt <= kMostClaims; ++attempt) {
    const absl::StatusOr<std::optional<VehicleKey>> claimed =
        TryToClaim(connection, id, me);
    if (!claimed.ok()) return claimed.status();
    if (*claimed) return **claimed;
    const auto owner = connection.Run(kWhoOwns, Parameters().AddText(id));
    if (!owner.ok()) return owner.status();
    if (owner->size() == 0) return UnknownVehicle("'" + id + "'");
    const bool has_owner = !owner->IsNull(0, 1) && owner->Integer(0, 4) != 0;
    if (has_owner && owner->GetUuid(0, 1) != me) {
      return AskFor(connection, id, me, *owner);
    }
    // It has become free since, unless its head is lost.
    if (!owner->IsNull(0, 2)) continue;
    Warn("vehicle '" + Printable(id) + "' had no row in heads: it gets one");
    absl::Status made =
        connection.Run(kMakeHead, Parameters().AddText(id)).status();
    if (!made.ok()) return made;
  }
  // Others take it and lose it all the time, or this server is not alive in the
  // database and does not know it yet.
  return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               "vehicle '" + id + "' could not be claimed just now");
}

absl::StatusOr<std::optional<VehicleKey>> Ownership::TryToClaim(
    PostgresConnection& connection, const std::string& id, const Uuid& me) {
  {
    const MutexLock lock(&mutex_);
    being_taken_.insert(id);
  }
  const auto rows = connection.Run(kClaim, Parameters().AddText(id).Add(me));
  const MutexLock lock(&mutex_);
  being_taken_.erase(being_taken_.find(id));
  if (!rows.ok()) return rows.status();
  if (me != me_) return LeaseStale();
  if (rows->size() == 0) return std::optional<VehicleKey>();
  auto claim = std::make_shared<Claim>();
  claim->owner = me;
  claim->epoch = rows->Integer(0, 1);
  if (selves_.count(rows->GetUuid(0, 3)) > 0) {
    claim->previous_epoch = claim->epoch - 1;
  }
  claim->since = Now();
  claim->vehicle_id = id;
  claim->revision = Unsigned(rows->Integer(0, 2));
  const VehicleKey key = rows->Integer(0, 0);
  highest_key_ = std::max(highest_key_, key);
  asks_.Taken(key, claim->since);
  claims_[key] = std::move(claim);
  wanted_.erase(key);
  return std::optional<VehicleKey>(key);
}

absl::Status Ownership::AskFor(PostgresConnection& connection,
                               const std::string& id, const Uuid& me,
                               const PostgresRows& owner) {
  const VehicleKey key = owner.Integer(0, 0);
  const Uuid other = owner.GetUuid(0, 1);
  bool asks = false;
  {
    const MutexLock lock(&mutex_);
    asks = asks_.MayAsk(key, Now());
  }
  if (asks) {
    absl::Status asked =
        connection.Run(kAsk, Parameters().Add(key).Add(other).Add(me)).status();
    if (!asked.ok()) return asked;
  }
  return NotOwner(id, owner.Bytes(0, 3), owner.Integer(0, 2));
}

std::shared_ptr<const Claim> Ownership::Find(VehicleKey key) const {
  const MutexLock lock(&mutex_);
  const auto found = claims_.find(key);
  return found == claims_.end() ? nullptr : found->second;
}

Uuid Ownership::Self() const {
  const MutexLock lock(&mutex_);
  return me_;
}

VehicleKey Ownership::HighestKey() const {
  const MutexLock lock(&mutex_);
  return highest_key_;
}

void Ownership::Forget(VehicleKey key, const Claim* claim, bool lost) {
  claim->has_ended = true;
  const MutexLock lock(&mutex_);
  const auto found = claims_.find(key);
  if (found != claims_.end() && found->second.get() == claim) {
    claims_.erase(found);
    wanted_.erase(key);
    if (lost) ++lost_vehicles_;
  }
}

absl::Status Ownership::Release(PostgresConnection& connection, VehicleKey key,
                                const Uuid& owner, std::int64_t epoch) {
  return connection.Run(kRelease, Parameters().Add(key).Add(owner).Add(epoch))
      .status();
}

absl::Status Ownership::Check(VehicleKey key) const {
  const MutexLock lock(&mutex_);
  if (claims_.count(key) == 0) {
    return Fenced("the vehicle of key " + std::to_string(key));
  }
  return LeaseHolds() ? absl::OkStatus() : LeaseStale();
}

absl::Status Ownership::CheckLease() const {
  const MutexLock lock(&mutex_);
  return LeaseHolds() ? absl::OkStatus() : LeaseStale();
}

void Ownership::OnWanted(Storage::HandOver hand_over) {
  const MutexLock lock(&mutex_);
  while (is_telling_) wake_.Wait(&mutex_);
  hand_over_ = std::move(hand_over);
  wake_.NotifyAll();
}

void Ownership::Leave() {
  const MutexLock lock(&mutex_);
  leaving_ = true;
  wake_.NotifyAll();
}

absl::StatusOr<std::vector<StorageUser>> Ownership::Users() const {
  const MutexLock lock(&mutex_);
  if (!LeaseHolds()) return LeaseStale();
  std::vector<StorageUser> users = others_;
  users.push_back(
      {options_.address, static_cast<std::int64_t>(claims_.size())});
  std::sort(users.begin(), users.end(),
            [](const StorageUser& a, const StorageUser& b) {
              return a.address < b.address;
            });
  return users;
}

SharingState Ownership::GetSharing() const {
  const MutexLock lock(&mutex_);
  SharingState sharing;
  sharing.owned_vehicles = static_cast<std::int64_t>(claims_.size());
  sharing.lost_vehicles = lost_vehicles_;
  sharing.lost_leases = lost_leases_;
  sharing.lease_holds = LeaseHolds();
  return sharing;
}

Durability Ownership::durability() const {
  const MutexLock lock(&mutex_);
  return durability_;
}

}  // namespace revisit::server
