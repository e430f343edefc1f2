// Shared by tests that read and write a storage.
#ifndef REVISIT_TESTS_SERVER_STORAGE_TESTING_H_
#define REVISIT_TESTS_SERVER_STORAGE_TESTING_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/storage.h"

namespace revisit::server {

// The poses that a revision brings.
BatchSource BatchesOf(std::vector<BatchRecord> batches);

// Appends one batch.
void AppendBatch(Storage& storage, VehicleKey key, BatchRecord batch,
                 std::optional<std::string> vehicle_payload,
                 Storage::Done done);

// The writes of a storage, waited for.
class BlockingWrites {
 public:
  explicit BlockingWrites(Storage* storage) : storage_(storage) {}

  // The vehicle is taken too, so that it can be written.
  absl::StatusOr<VehicleKey> Create(const std::string& id,
                                    const std::string& payload = "payload",
                                    std::uint64_t revision = 1);
  absl::Status Update(VehicleKey key, const std::string& payload,
                      std::uint64_t revision);
  absl::Status Delete(VehicleKey key, const EventRecord& farewell = {});
  absl::Status Append(VehicleKey key, const BatchRecord& batch);
  absl::Status AppendAll(
      VehicleKey key, const std::vector<BatchRecord>& batches,
      const std::optional<std::string>& vehicle_payload = std::nullopt);
  absl::Status AppendWithVehicle(VehicleKey key, const BatchRecord& batch,
                                 const std::string& vehicle_payload);
  absl::Status Revise(VehicleKey key, const std::vector<BatchRecord>& batches,
                      std::uint64_t revision);
  absl::Status Replace(VehicleKey key,
                       const std::vector<BatchVersions>& batches,
                       std::uint64_t revision);
  absl::Status AddPair(VehicleKey key, PairKind kind,
                       const PosePairRecord& pair, std::uint64_t revision,
                       const std::optional<ChecksWrite>& checks = std::nullopt);
  absl::Status DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                           const std::string& payload, std::uint64_t revision);
  absl::Status PutSnapshotPart(VehicleKey key, std::uint32_t number,
                               const std::string& part);
  absl::Status PutSnapshot(VehicleKey key, const SnapshotRecord& snapshot);
  absl::Status DropSnapshot(VehicleKey key);
  absl::Status PutMarks(VehicleKey key, const std::string& marks);
  absl::Status Confirm(VehicleKey key);
  // Deletes the pair and keeps a record of it that has its id alone.
  absl::Status DeletePair(VehicleKey key, PairKind kind, const std::string& id,
                          std::uint64_t revision);
  absl::Status DeletePair(
      VehicleKey key, const DeletedPairRecord& deleted, std::uint64_t revision,
      const std::optional<ChecksWrite>& checks = std::nullopt);
  absl::Status PutChecks(VehicleKey key, const ChecksWrite& checks);
  absl::Status DropEvents(std::int64_t before_ns, int most);

 private:
  Storage* const storage_;
};

// The writes of a storage's groups, waited for.
class BlockingGroupWrites {
 public:
  explicit BlockingGroupWrites(Storage* storage) : groups_(storage->Groups()) {}

  absl::StatusOr<std::uint64_t> Create(const std::string& id,
                                       const std::string& payload = "payload",
                                       const std::string& uid = "uid");
  absl::StatusOr<std::uint64_t> Change(
      const std::string& id, const std::vector<GroupChange>& changes,
      const std::optional<GroupVersion>& expected = std::nullopt);
  absl::StatusOr<std::uint64_t> Delete(
      const std::string& id,
      const std::optional<GroupVersion>& expected = std::nullopt);

 private:
  GroupStorage& groups_;
};

// Collects what ReadBatches() visits.
absl::StatusOr<std::vector<BatchRecord>> ReadAll(
    Storage& storage, VehicleKey key, std::uint64_t first, std::uint64_t last,
    BatchVersion version = BatchVersion::kCurrent);

// The snapshot of a vehicle with its parts, such as "to 7: one two, 'rest'";
// "none" if there is none, or the word for what is wrong.
std::string SnapshotOf(Storage& storage, VehicleKey key);
// The marks of a vehicle; "none" or "damaged".
std::string MarksOf(Storage& storage, VehicleKey key);

// "id 7: 3 closures, 1 rejected, to 12, revision 5, 'payload'" and the like, to
// compare whole records.
std::string ToText(const VehicleRecord& record);
std::string ToText(const BatchRecord& record);
std::string ToText(const PosePairRecord& record);
// "7: 2 open, revision 5, 9 ns, 'payload'" and the like.
std::string ToText(const CheckRecord& record);
// "3: 9 ns, 'payload'" and the like, without its position.
std::string ToText(const EventRecord& record);
// "1, closure a: 9 at 2, 7 ns, deleted at 8 ns" and the like.
std::string ToText(const DeletedPairRecord& record);
// "id uid: revision 3, 'payload'" and the like.
std::string ToText(const GroupRecord& record);
// "truck: 'payload'".
std::string ToText(const GroupMemberRecord& record);
// "id, confirmed: 9 of 1 at 2 of 7, 'payload'", with the vehicles' keys.
std::string ToText(const GroupLinkRecord& record);
// The group and the link.
std::string ToText(const PlacedLink& record);
template <typename T>
std::vector<std::string> ToTexts(const std::vector<T>& records) {
  std::vector<std::string> texts;
  for (const T& record : records) texts.push_back(ToText(record));
  return texts;
}

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_TESTING_H_
