// The checks that every storage makes of the rows it has read, and the errors
// that all storages answer with, so that they differ in nothing but where the
// rows are.
#ifndef REVISIT_SERVER_STORAGE_RECORD_CHECK_H_
#define REVISIT_SERVER_STORAGE_RECORD_CHECK_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/storage/records.h"

namespace revisit::server {

// Makes text from a store that may be damaged fit for a message: characters
// other than printable ASCII become question marks. Valid ids have none.
std::string Printable(std::string text);
// The text before which all valid ids with this prefix come, and behind which
// none does: ids are ASCII.
std::string BeyondPrefix(const std::string& prefix);

// ---- Errors

// NOT_FOUND (VEHICLE_NOT_FOUND); `which` is such as "key 7".
absl::Status UnknownVehicle(const std::string& which);
absl::Status UnknownVehicle(VehicleKey key);
// ALREADY_EXISTS (VEHICLE_EXISTS).
absl::Status VehicleExists(const std::string& id);
// FAILED_PRECONDITION (SEQUENCE_GAP).
absl::Status SequenceGap(const std::string& vehicle_id, std::uint64_t expected,
                         std::uint64_t first_sequence);
// FAILED_PRECONDITION, for a revision of a batch that is not stored.
absl::Status NoSuchBatch(const BatchRecord& batch);
// FAILED_PRECONDITION, for DropDamaged().
absl::Status NoSuchBatches(std::uint64_t first, std::uint64_t last);
absl::Status NoBatchEndsAt(std::uint64_t sequence);
// ALREADY_EXISTS (WordsOf(kind).exists).
absl::Status PairExists(PairKind kind, const std::string& id);
// NOT_FOUND (WordsOf(kind).not_found).
absl::Status NoSuchPair(PairKind kind, const std::string& id);
// FAILED_PRECONDITION, for a part of a snapshot that is not kept.
absl::Status NoSuchSnapshotPart(std::uint32_t number);

// ---- Rows as they were read. A row is sound if its checksum matches and its
// format is known here.

// DATA_LOSS (STORE_CORRUPT) unless the row is sound.
absl::Status CheckRow(std::int64_t format, std::int64_t stored_checksum,
                      std::int64_t computed_checksum, const std::string& what,
                      const ErrorMetadata& metadata);

// Sets `damage`, and clears the members that a damaged row does not give.
void CheckVehicleRow(std::int64_t format, std::int64_t checksum,
                     VehicleRecord* record);

struct StoredBatch {
  std::int64_t first_sequence = 0;
  std::int64_t count = 0;
  std::int64_t format = 0;
  std::int64_t revision = 0;
  std::int64_t checksum = 0;
  std::string payload;
};
// DATA_LOSS (STORE_CORRUPT) unless the row is sound.
absl::StatusOr<BatchRecord> CheckedBatch(StoredBatch row, VehicleKey key,
                                         const std::string& vehicle_id,
                                         BatchVersion version);
// The sequence at which a batch ends according to its row, damaged or not.
std::uint64_t ClaimedEnd(std::int64_t first_sequence, std::int64_t count);
// The most poses that the row of a damaged batch is believed to hold.
inline constexpr std::int64_t kMostClaimedPoses = 1'000'000;

// Sets `damage`.
void CheckPosePairRow(std::int64_t format, std::int64_t checksum,
                      VehicleKey key, PairKind kind,
                      const std::string& vehicle_id, PosePairRecord* pair);
// Sets kind and damage of a record whose other members are as they were read.
void CheckDeletedPairRow(std::int64_t format, std::int64_t checksum,
                         VehicleKey key, std::int64_t kind,
                         const std::string& vehicle_id,
                         DeletedPairRecord* deleted);
// The number of the next pair that is deleted, after this one. DATA_LOSS
// (STORE_CORRUPT) if there is none, since the number is damaged.
absl::StatusOr<std::uint64_t> NumberAfter(std::int64_t number);

// DATA_LOSS (STORE_CORRUPT) unless the row is sound. `snapshot` is as in
// ChecksumOfSnapshotPart().
absl::Status CheckSnapshotRow(std::int64_t format, std::int64_t checksum,
                              VehicleKey key, const SnapshotRecord& snapshot);
absl::Status CheckSnapshotPartRow(std::int64_t format, std::int64_t checksum,
                                  std::int64_t snapshot, std::uint32_t number,
                                  absl::string_view part);
absl::Status CheckMarksRow(std::int64_t format, std::int64_t checksum,
                           std::int64_t snapshot, absl::string_view marks);
// DATA_LOSS (STORE_CORRUPT).
absl::Status MissingSnapshotPart(std::uint32_t number);

// Sets `damage`, and clears the members that a damaged row does not give.
void CheckCheckRow(std::int64_t format, std::int64_t checksum, VehicleKey key,
                   const std::string& vehicle_id, CheckRecord* check);
// Sets position and `damage` of an event whose number, time and payload are as
// they were read. A payload that went with its vehicle is no damage.
void CheckEventRow(std::int64_t format, std::int64_t checksum, VehicleKey key,
                   std::uint64_t order, EventRecord* event);
// DATA_LOSS (STORE_CORRUPT) unless the row is sound.
absl::Status CheckChecksHeadRow(std::int64_t format, std::int64_t checksum,
                                VehicleKey key, const ChecksHead& head);
// FAILED_PRECONDITION (INTERNAL), for PutChecks().
absl::Status OtherChecksHead(const ChecksHead& stored,
                             const ChecksHead& expected);
// OUT_OF_RANGE (CURSOR_TOO_OLD) and (CURSOR_UNKNOWN), for ReadEvents().
absl::Status CursorTooOld();
absl::Status CursorUnknown();

// Follows the rows of a range of batches as Storage::ReadBatches() visits them.
class BatchWalk {
 public:
  BatchWalk(VehicleKey key, std::string vehicle_id,
            std::uint64_t first_sequence, std::uint64_t last_sequence)
      : key_(key),
        vehicle_id_(std::move(vehicle_id)),
        first_sequence_(first_sequence),
        last_sequence_(last_sequence),
        expected_(first_sequence) {}

  // Whether no row is needed any more.
  bool IsDone() const { return expected_ > last_sequence_; }
  // Checks the next row, with its revised version if there is one; returns the
  // current one. DATA_LOSS (STORE_CORRUPT) if a row is damaged or is not the
  // next one.
  absl::StatusOr<BatchRecord> Next(StoredBatch as_sent,
                                   std::optional<StoredBatch> revised);
  // DATA_LOSS (STORE_CORRUPT), for rows that end too early.
  absl::Status Missing() const;

 private:
  const VehicleKey key_;
  const std::string vehicle_id_;
  const std::uint64_t first_sequence_;
  const std::uint64_t last_sequence_;
  std::uint64_t expected_;
};

// ---- Numbers: databases know signed ones only, and sequences and revisions
// are below 2^63.

std::int64_t Signed(std::uint64_t value);
inline std::uint64_t Unsigned(std::int64_t value) {
  return static_cast<std::uint64_t>(value);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_RECORD_CHECK_H_
