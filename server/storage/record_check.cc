#include "server/storage/record_check.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

std::string Range(const BatchRecord& batch) {
  return std::to_string(batch.first_sequence) + " to " +
         std::to_string(batch.first_sequence + batch.count - 1);
}

}  // namespace

std::string Printable(std::string text) {
  for (char& c : text) {
    if (c < ' ' || c > '~') c = '?';
  }
  return text;
}

std::string BeyondPrefix(const std::string& prefix) { return prefix + "\x7f"; }

absl::Status UnknownVehicle(const std::string& which) {
  return Error(StatusCode::kNotFound, "VEHICLE_NOT_FOUND",
               "no such vehicle: " + which);
}

absl::Status UnknownVehicle(VehicleKey key) {
  return UnknownVehicle("key " + std::to_string(key));
}

absl::Status VehicleExists(const std::string& id) {
  return Error(StatusCode::kAlreadyExists, "VEHICLE_EXISTS",
               "vehicle '" + id + "' exists already");
}

absl::Status SequenceGap(const std::string& vehicle_id, std::uint64_t expected,
                         std::uint64_t first_sequence) {
  return Error(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
               "vehicle '" + vehicle_id + "': got a batch from sequence " +
                   std::to_string(first_sequence) + ", expected " +
                   std::to_string(expected),
               {{"expected_sequence", std::to_string(expected)}});
}

absl::Status NoSuchBatch(const BatchRecord& batch) {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL",
               "no batch with sequences " + Range(batch) +
                   " is stored that could be revised");
}

absl::Status NoSuchBatches(std::uint64_t first, std::uint64_t last) {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL",
               "no whole batches hold the sequences " + std::to_string(first) +
                   " to " + std::to_string(last) + " that are to be replaced");
}

absl::Status NoBatchEndsAt(std::uint64_t sequence) {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL",
               "no batch ends at sequence " + std::to_string(sequence));
}

absl::Status PairExists(PairKind kind, const std::string& id) {
  const PairWords words = WordsOf(kind);
  return Error(StatusCode::kAlreadyExists, words.exists,
               std::string(words.noun) + " '" + id + "' exists already");
}

absl::Status NoSuchPair(PairKind kind, const std::string& id) {
  const PairWords words = WordsOf(kind);
  return Error(StatusCode::kNotFound, words.not_found,
               "no such " + std::string(words.noun) + ": '" + id + "'");
}

absl::Status NoSuchSnapshotPart(std::uint32_t number) {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL",
               "part " + std::to_string(number) +
                   " of the vehicle's snapshot is not kept");
}

absl::Status CheckRow(std::int64_t format, std::int64_t stored_checksum,
                      std::int64_t computed_checksum, const std::string& what,
                      const ErrorMetadata& metadata) {
  if (stored_checksum != computed_checksum) {
    return Corrupt(what + " fails its checksum", metadata);
  }
  if (format < kOldestStoreFormat || format > kStoreFormat) {
    return Corrupt(what + " has format " + std::to_string(format) +
                       "; known are " + std::to_string(kOldestStoreFormat) +
                       " to " + std::to_string(kStoreFormat),
                   metadata);
  }
  return absl::OkStatus();
}

void CheckVehicleRow(std::int64_t format, std::int64_t checksum,
                     VehicleRecord* record) {
  record->damage =
      CheckRow(format, checksum, ChecksumOfVehicle(format, *record),
               "stored vehicle '" + Printable(record->id) + "'",
               {{"vehicle", Printable(record->id)}});
  if (!record->damage.ok()) {
    record->payload.clear();
    record->revision = 0;
  }
}

absl::StatusOr<BatchRecord> CheckedBatch(StoredBatch row, VehicleKey key,
                                         const std::string& vehicle_id,
                                         BatchVersion version) {
  BatchRecord batch;
  batch.first_sequence = Unsigned(row.first_sequence);
  batch.count = static_cast<std::uint32_t>(row.count);
  batch.revision = Unsigned(row.revision);
  batch.payload = std::move(row.payload);
  const std::int64_t checksum =
      ChecksumOfBatch(row.format, key, version, batch);
  const absl::Status status =
      CheckRow(row.format, row.checksum, checksum,
               std::string("stored batch of vehicle '") + vehicle_id +
                   "', sequences " + Range(batch) +
                   (version == BatchVersion::kCurrent ? ", revised," : ""),
               {{"vehicle", vehicle_id},
                {"first_sequence", std::to_string(batch.first_sequence)}});
  if (!status.ok()) return status;
  if (row.count < 1 || row.count != batch.count) {
    return Corrupt("stored batch of vehicle '" + vehicle_id + "' has " +
                       std::to_string(row.count) + " poses",
                   {{"vehicle", vehicle_id}});
  }
  return batch;
}

std::uint64_t ClaimedEnd(std::int64_t first_sequence, std::int64_t count) {
  return Unsigned(first_sequence) +
         Unsigned(std::clamp(count, std::int64_t{1}, kMostClaimedPoses)) - 1;
}

void CheckPosePairRow(std::int64_t format, std::int64_t checksum,
                      VehicleKey key, PairKind kind,
                      const std::string& vehicle_id, PosePairRecord* pair) {
  const PairWords words = WordsOf(kind);
  pair->damage =
      CheckRow(format, checksum, ChecksumOfPosePair(format, key, kind, *pair),
               "stored " + std::string(words.noun) + " '" +
                   Printable(pair->id) + "' of vehicle '" + vehicle_id + "'",
               {{"vehicle", vehicle_id}, {words.field, Printable(pair->id)}});
}

void CheckDeletedPairRow(std::int64_t format, std::int64_t checksum,
                         VehicleKey key, std::int64_t kind,
                         const std::string& vehicle_id,
                         DeletedPairRecord* deleted) {
  deleted->kind = kind == NumberOf(PairKind::kLoopClosure)
                      ? PairKind::kLoopClosure
                      : PairKind::kRejectedCandidate;
  const std::string what = "stored deletion " +
                           std::to_string(deleted->number) + " of vehicle '" +
                           vehicle_id + "'";
  const ErrorMetadata metadata = {{"vehicle", vehicle_id}};
  deleted->pair.damage =
      kind == NumberOf(deleted->kind)
          ? CheckRow(format, checksum,
                     ChecksumOfDeletedPair(format, key, *deleted), what,
                     metadata)
          : Corrupt(what + " is one of no kind", metadata);
}

absl::StatusOr<std::uint64_t> NumberAfter(std::int64_t number) {
  if (number < 0 || number == std::numeric_limits<std::int64_t>::max()) {
    return Corrupt("the number of a stored deletion is damaged");
  }
  return Unsigned(number) + 1;
}

absl::Status CheckSnapshotRow(std::int64_t format, std::int64_t checksum,
                              VehicleKey key, const SnapshotRecord& snapshot) {
  return CheckRow(format, checksum, ChecksumOfSnapshot(format, key, snapshot),
                  "stored snapshot", {});
}

absl::Status CheckSnapshotPartRow(std::int64_t format, std::int64_t checksum,
                                  std::int64_t snapshot, std::uint32_t number,
                                  absl::string_view part) {
  return CheckRow(
      format, checksum, ChecksumOfSnapshotPart(format, snapshot, number, part),
      "part " + std::to_string(number) + " of a stored snapshot", {});
}

absl::Status CheckMarksRow(std::int64_t format, std::int64_t checksum,
                           std::int64_t snapshot, absl::string_view marks) {
  return CheckRow(format, checksum,
                  ChecksumOfSnapshotPart(format, snapshot, kMarksPart, marks),
                  "row of stored marks", {});
}

absl::Status MissingSnapshotPart(std::uint32_t number) {
  return Corrupt(
      "part " + std::to_string(number) + " of a stored snapshot is missing",
      {});
}

void CheckCheckRow(std::int64_t format, std::int64_t checksum, VehicleKey key,
                   const std::string& vehicle_id, CheckRecord* check) {
  check->damage = CheckRow(
      format, checksum, ChecksumOfCheck(format, key, *check),
      "stored check " + std::to_string(check->sequence) + " of vehicle '" +
          vehicle_id + "'",
      {{"vehicle", vehicle_id}, {"sequence", std::to_string(check->sequence)}});
  if (!check->damage.ok()) {
    *check = {check->sequence, 0, 0, 0, "", std::move(check->damage)};
  }
}

void CheckEventRow(std::int64_t format, std::int64_t checksum, VehicleKey key,
                   std::uint64_t order, EventRecord* event) {
  event->position = {order, key, event->number, checksum};
  if (event->payload.empty()) return;
  event->damage =
      CheckRow(format, checksum, ChecksumOfEvent(format, key, *event),
               "stored event " + std::to_string(event->number) +
                   " of the vehicle of key " + std::to_string(key),
               {});
  if (!event->damage.ok()) event->payload.clear();
}

absl::Status CheckChecksHeadRow(std::int64_t format, std::int64_t checksum,
                                VehicleKey key, const ChecksHead& head) {
  return CheckRow(
      format, checksum, ChecksumOfChecksHead(format, key, head),
      "the head of the checks of the vehicle of key " + std::to_string(key),
      {});
}

absl::Status OtherChecksHead(const ChecksHead& stored,
                             const ChecksHead& expected) {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL",
               "the stored checks reach sequence " +
                   std::to_string(stored.checked_sequence) + " and event " +
                   std::to_string(stored.last_event) + ", not " +
                   std::to_string(expected.checked_sequence) + " and " +
                   std::to_string(expected.last_event));
}

absl::Status CursorTooOld() {
  return Error(StatusCode::kOutOfRange, "CURSOR_TOO_OLD",
               "events behind the cursor are kept no longer: list the checks, "
               "and watch from the cursor that the list answers");
}

absl::Status CursorUnknown() {
  return Error(StatusCode::kOutOfRange, "CURSOR_UNKNOWN",
               "this store has no event at the cursor: it is of another store, "
               "or the store was restored from before it; list the checks, and "
               "watch from the cursor that the list answers");
}

absl::StatusOr<BatchRecord> BatchWalk::Next(
    StoredBatch as_sent, std::optional<StoredBatch> revised) {
  absl::StatusOr<BatchRecord> batch = CheckedBatch(
      std::move(as_sent), key_, vehicle_id_, BatchVersion::kAsSent);
  // The batch as sent must be sound as well, because resent poses are compared
  // with it.
  if (batch.ok() && revised) {
    batch = CheckedBatch(*std::move(revised), key_, vehicle_id_,
                         BatchVersion::kCurrent);
  }
  if (!batch.ok()) return batch;
  const std::uint64_t end = batch->first_sequence + batch->count;
  // The first may begin before the range, all others follow each other.
  const bool fits =
      (expected_ == first_sequence_ ? batch->first_sequence <= expected_
                                    : batch->first_sequence == expected_) &&
      end > expected_;
  if (!fits) return Missing();
  expected_ = end;
  return batch;
}

absl::Status BatchWalk::Missing() const {
  return Corrupt(
      "vehicle '" + vehicle_id_ + "': sequence " + std::to_string(expected_) +
          " is not in the store",
      {{"vehicle", vehicle_id_}, {"sequence", std::to_string(expected_)}});
}

std::int64_t Signed(std::uint64_t value) {
  return static_cast<std::int64_t>(
      std::min<std::uint64_t>(value, std::numeric_limits<std::int64_t>::max()));
}

}  // namespace revisit::server
