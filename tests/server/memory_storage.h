// The storage's contract in the plainest way: maps, and nothing that lasts. It
// is the model that real storages are compared with, and it passes the
// contract's tests itself.
#ifndef REVISIT_TESTS_SERVER_MEMORY_STORAGE_H_
#define REVISIT_TESTS_SERVER_MEMORY_STORAGE_H_

#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "server/storage/storage.h"
#include "tests/server/memory_groups.h"

namespace revisit::server {

// Writes are done, and answered, before the call returns.
class MemoryStorage : public Storage {
 public:
  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override;
  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override;
  void DeleteVehicle(VehicleKey key, EventRecord farewell, Done done) override;
  void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::optional<std::string> vehicle_payload,
                     Done done) override;
  std::size_t MostBatchBytes() const override { return most_batch_bytes_; }
  bool KeepsColumns() const override { return keeps_columns_; }
  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override;
  void ReplaceBatches(VehicleKey key, std::vector<BatchVersions> batches,
                      std::uint64_t revision, Done done) override;
  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::optional<ChecksWrite> checks, std::uint64_t revision,
                   Done done) override;
  void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                      std::optional<ChecksWrite> checks, std::uint64_t revision,
                      Done done) override;
  void PutChecks(VehicleKey key, ChecksWrite checks, Done done) override;
  void DropEvents(std::int64_t before_ns, int most, Done done) override;

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override;

  bool KeepsSnapshots() const override { return true; }
  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override;
  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot, Done done) override;
  void DropSnapshot(VehicleKey key, Done done) override;
  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override;
  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override;
  void PutMarks(VehicleKey key, std::string marks, Done done) override;
  absl::StatusOr<std::optional<std::string>> GetMarks(VehicleKey key) override;

  // The answer of MostBatchBytes().
  void SetMostBatchBytes(std::size_t bytes) { most_batch_bytes_ = bytes; }
  // The answer of KeepsColumns().
  void SetKeepsColumns(bool keeps) { keeps_columns_ = keeps; }
  // As found by every read from now on.
  void DamageVehicle(const std::string& id);
  // This pose as it was sent and as it is now.
  void DamagePose(const std::string& id, std::uint64_t sequence);
  void DamagePair(const std::string& id, PairKind kind,
                  const std::string& pair_id);
  // The pair that was deleted last.
  void DamageDeletedPair(const std::string& id);

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override;
  absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) override;
  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override;
  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override;
  absl::StatusOr<std::vector<DeletedPairRecord>> ListDeletedPairs(
      VehicleKey key) override;
  absl::StatusOr<std::vector<CheckRecord>> ListChecks(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      bool open_only, int limit) override;
  absl::StatusOr<std::vector<VehicleRecord>> ListUnchecked(VehicleKey after_key,
                                                           int limit) override;
  absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) override;
  absl::StatusOr<EventPosition> LastEvent() override;
  GroupStorage& Groups() override { return groups_; }

 private:
  struct Batch {
    BatchRecord as_sent;
    BatchRecord current;
    bool is_damaged = false;
  };
  struct Vehicle {
    VehicleRecord record;
    std::vector<Batch> batches;
    // By kind, then by id.
    std::map<PairKind, std::map<std::string, PosePairRecord>> pairs;
    // The last one first.
    std::deque<DeletedPairRecord> deleted_pairs;
    std::map<std::uint64_t, CheckRecord> checks;
    std::vector<std::string> snapshot_parts;
    std::optional<SnapshotRecord> snapshot;
    std::optional<std::string> marks;

    void DropSnapshot() {
      snapshot_parts.clear();
      snapshot.reset();
      marks.reset();
    }
  };

  absl::Status Change(VehicleKey key, std::uint64_t revision,
                      const std::function<absl::Status(Vehicle&)>& change);
  Vehicle& Find(const std::string& id);
  // REQUIRES: the mutex is held.
  std::optional<std::string> IdOf(VehicleKey key) const;
  absl::Status Store(VehicleKey key, const ChecksWrite& write,
                     Vehicle* vehicle);
  void AddEvent(VehicleKey key, EventRecord event);
  static VehicleRecord Complete(const Vehicle& vehicle);

  std::size_t most_batch_bytes_ = Storage::MostBatchBytes();
  bool keeps_columns_ = true;
  std::mutex mutex_;
  VehicleKey last_key_ = 0;
  std::map<VehicleKey, Vehicle> vehicles_;
  std::vector<EventRecord> events_;
  EventPosition dropped_;
  std::uint64_t last_order_ = 0;
  MemoryGroups groups_{&mutex_, [this](VehicleKey key) { return IdOf(key); }};
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_MEMORY_STORAGE_H_
