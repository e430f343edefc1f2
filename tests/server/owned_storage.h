// A storage that several servers share, as one of them sees it.
#ifndef REVISIT_TESTS_SERVER_OWNED_STORAGE_H_
#define REVISIT_TESTS_SERVER_OWNED_STORAGE_H_

#include <cstdint>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Who owns which vehicle, and since which epoch. Thread-safe.
class Owners {
 public:
  struct Owner {
    std::string server;
    std::uint64_t epoch = 0;
    bool is_wanted = false;
  };

  // The owner after the server has asked for the vehicle.
  Owner Take(VehicleKey key, const std::string& server) {
    const std::lock_guard<std::mutex> guard(mutex_);
    Owner& owner = owners_[key];
    if (owner.server.empty() || owner.server == server) {
      owner = {server, owner.epoch + 1, false};
    } else {
      owner.is_wanted = true;
    }
    return owner;
  }
  // Takes the vehicle without asking, as from a server that was declared dead.
  void Seize(VehicleKey key, const std::string& server) {
    const std::lock_guard<std::mutex> guard(mutex_);
    owners_[key] = {server, owners_[key].epoch + 1, false};
  }
  void Release(VehicleKey key, const std::string& server) {
    const std::lock_guard<std::mutex> guard(mutex_);
    if (owners_[key].server == server) owners_[key].server.clear();
  }
  Owner Get(VehicleKey key) const {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto found = owners_.find(key);
    return found == owners_.end() ? Owner() : found->second;
  }
  std::vector<VehicleKey> WantedOf(const std::string& server) const {
    const std::lock_guard<std::mutex> guard(mutex_);
    std::vector<VehicleKey> keys;
    for (const auto& [key, owner] : owners_) {
      if (owner.server == server && owner.is_wanted) keys.push_back(key);
    }
    return keys;
  }

 private:
  mutable std::mutex mutex_;
  std::map<VehicleKey, Owner> owners_;
};

// Passes on what the server of this name may write, and all reads, to another
// storage, which must outlive it. Thread-safe.
class OwnedStorage : public Storage {
 public:
  OwnedStorage(Storage* storage, Owners* owners, std::string server)
      : storage_(storage), owners_(owners), server_(std::move(server)) {}

  // What CheckOwned() answers where the vehicle is this server's.
  void SetLease(const absl::Status& lease) {
    const std::lock_guard<std::mutex> guard(mutex_);
    lease_ = lease;
  }
  // This server does not know any more what it owns, as after it was declared
  // dead and joined again.
  void ForgetEpochs() {
    const std::lock_guard<std::mutex> guard(mutex_);
    epochs_.clear();
  }

  // Tells this server, on this thread, of the vehicles that others ask for.
  void TellWanted() {
    HandOver hand_over;
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      hand_over = hand_over_;
    }
    const auto vehicles = storage_->ListVehicles("", "", 1000);
    for (const VehicleKey key : owners_->WantedOf(server_)) {
      for (const VehicleRecord& vehicle : *vehicles) {
        if (vehicle.key == key) hand_over({key, vehicle.id});
      }
    }
  }

  absl::StatusOr<VehicleRecord> TakeVehicle(const std::string& id) override {
    const auto before = storage_->GetVehicle(id);
    if (!before.ok()) return before;
    const Owners::Owner previous = owners_->Get(before->key);
    const Owners::Owner owner = owners_->Take(before->key, server_);
    if (owner.server != server_) {
      return Error(absl::StatusCode::kUnavailable, "NOT_OWNER",
                   "vehicle '" + id + "' is on another server",
                   {{"owner", owner.server}});
    }
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      epochs_[before->key] = owner.epoch;
    }
    auto record = storage_->GetVehicle(id);
    if (record.ok()) {
      record->epoch = static_cast<std::int64_t>(owner.epoch);
      if (previous.server == server_) {
        record->previous_epoch = static_cast<std::int64_t>(previous.epoch);
      }
    }
    return record;
  }
  void ReleaseVehicle(VehicleKey key) override {
    owners_->Release(key, server_);
    const std::lock_guard<std::mutex> guard(mutex_);
    epochs_.erase(key);
  }
  absl::Status CheckOwned(VehicleKey key) const override {
    const std::lock_guard<std::mutex> guard(mutex_);
    if (!lease_.ok()) return lease_;
    return IsMine(key) ? absl::OkStatus() : Fenced();
  }
  void ConfirmOwned(VehicleKey key, Done done) override {
    if (Refuses(key, done)) return;
    storage_->ConfirmOwned(key, std::move(done));
  }
  void OnWanted(const HandOver& hand_over) override {
    const std::lock_guard<std::mutex> guard(mutex_);
    hand_over_ = hand_over;
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    storage_->CreateVehicle(std::move(record), std::move(done));
  }
  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override {
    if (Refuses(key, done)) return;
    storage_->UpdateVehicle(key, std::move(payload), revision, std::move(done));
  }
  void DeleteVehicle(VehicleKey key, EventRecord farewell, Done done) override {
    if (Refuses(key, done)) return;
    storage_->DeleteVehicle(key, std::move(farewell), std::move(done));
  }
  void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::optional<std::string> vehicle_payload,
                     Done done) override {
    if (Refuses(key, done)) return;
    storage_->AppendBatches(key, std::move(batches), std::move(vehicle_payload),
                            std::move(done));
  }
  bool KeepsColumns() const override { return storage_->KeepsColumns(); }
  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    if (Refuses(key, done)) return;
    storage_->ReviseBatches(key, std::move(batches), revision, std::move(done));
  }
  void ReplaceBatches(VehicleKey key, std::vector<BatchVersions> batches,
                      std::uint64_t revision, Done done) override {
    if (Refuses(key, done)) return;
    storage_->ReplaceBatches(key, std::move(batches), revision,
                             std::move(done));
  }
  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::optional<ChecksWrite> checks, std::uint64_t revision,
                   Done done) override {
    if (Refuses(key, done)) return;
    storage_->AddPosePair(key, kind, std::move(pair), std::move(checks),
                          revision, std::move(done));
  }
  void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                      std::optional<ChecksWrite> checks, std::uint64_t revision,
                      Done done) override {
    if (Refuses(key, done)) return;
    storage_->DeletePosePair(key, std::move(deleted), std::move(checks),
                             revision, std::move(done));
  }
  void PutChecks(VehicleKey key, ChecksWrite checks, Done done) override {
    if (Refuses(key, done)) return;
    storage_->PutChecks(key, std::move(checks), std::move(done));
  }
  void DropEvents(std::int64_t before_ns, int most, Done done) override {
    storage_->DropEvents(before_ns, most, std::move(done));
  }
  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    if (Refuses(key, done)) return;
    storage_->DropDamaged(key, last_sequence, std::move(payload), revision,
                          std::move(done));
  }

  bool KeepsSnapshots() const override { return storage_->KeepsSnapshots(); }
  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override {
    if (Refuses(key, done)) return;
    storage_->PutSnapshotPart(key, number, std::move(part), std::move(done));
  }
  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                   Done done) override {
    if (Refuses(key, done)) return;
    storage_->PutSnapshot(key, std::move(snapshot), std::move(done));
  }
  void DropSnapshot(VehicleKey key, Done done) override {
    if (Refuses(key, done)) return;
    storage_->DropSnapshot(key, std::move(done));
  }
  void PutMarks(VehicleKey key, std::string marks, Done done) override {
    if (Refuses(key, done)) return;
    storage_->PutMarks(key, std::move(marks), std::move(done));
  }
  absl::StatusOr<std::optional<std::string>> GetMarks(VehicleKey key) override {
    return storage_->GetMarks(key);
  }
  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override {
    return storage_->GetSnapshot(key);
  }
  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override {
    return storage_->ReadSnapshotParts(key, first, end, visit);
  }

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    return storage_->GetVehicle(id);
  }
  absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) override {
    return storage_->GetVehicles(ids);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override {
    return storage_->ListVehicles(after_id, prefix, limit);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) override {
    return storage_->ListVehicleRows(after_key, limit);
  }
  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    return storage_->ReadBatches(key, first_sequence, last_sequence, version,
                                 visit);
  }
  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override {
    return storage_->ListPosePairs(key, kind, after_id, limit);
  }
  absl::StatusOr<std::vector<DeletedPairRecord>> ListDeletedPairs(
      VehicleKey key) override {
    return storage_->ListDeletedPairs(key);
  }
  absl::StatusOr<std::vector<CheckRecord>> ListChecks(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      bool open_only, int limit) override {
    return storage_->ListChecks(key, first_sequence, last_sequence, open_only,
                                limit);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListUnchecked(VehicleKey after_key,
                                                           int limit) override {
    return storage_->ListUnchecked(after_key, limit);
  }
  absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) override {
    return storage_->ReadEvents(after, limit);
  }
  absl::StatusOr<EventPosition> LastEvent() override {
    return storage_->LastEvent();
  }
  GroupStorage& Groups() override { return storage_->Groups(); }

 private:
  static absl::Status Fenced() {
    return Error(absl::StatusCode::kAborted, "EPOCH_FENCED",
                 "the vehicle is another server's");
  }

  // Call with the mutex held.
  bool IsMine(VehicleKey key) const {
    const auto known = epochs_.find(key);
    const Owners::Owner owner = owners_->Get(key);
    return known != epochs_.end() && owner.server == server_ &&
           owner.epoch == known->second;
  }

  bool Refuses(VehicleKey key, const Done& done) const {
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      if (IsMine(key)) return false;
    }
    done(Fenced());
    return true;
  }

  Storage* const storage_;
  Owners* const owners_;
  const std::string server_;
  mutable std::mutex mutex_;
  std::map<VehicleKey, std::uint64_t> epochs_;
  absl::Status lease_;
  HandOver hand_over_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_OWNED_STORAGE_H_
