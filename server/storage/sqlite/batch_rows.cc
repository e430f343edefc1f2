#include "server/storage/sqlite/batch_rows.h"

#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/snapshot_rows.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

// The columns from `column` on are format, revision, checksum, payload.
StoredBatch ReadBatchRow(const SqliteStatement& row, int column,
                         std::int64_t first_sequence, std::int64_t count) {
  StoredBatch batch;
  batch.first_sequence = first_sequence;
  batch.count = count;
  batch.format = row.Integer(column);
  batch.revision = row.Integer(column + 1);
  batch.checksum = row.Integer(column + 2);
  batch.payload = row.Bytes(column + 3);
  return batch;
}

// `sql` is a literal, by whose address the connection caches the statement. Its
// parameters are vehicle_key, first_sequence, count, format, revision,
// checksum, payload.
absl::Status WriteBatchRow(SqliteDatabase& database, const char* sql,
                           VehicleKey key, BatchVersion version,
                           const BatchRecord& batch) {
  return database.Prepare(sql)
      .Bind(1, key)
      .Bind(2, Signed(batch.first_sequence))
      .Bind(3, batch.count)
      .Bind(4, kStoreFormat)
      .Bind(5, Signed(batch.revision))
      .Bind(6, ChecksumOfBatch(kStoreFormat, key, version, batch))
      .BindBlob(7, batch.payload)
      .Run();
}

constexpr char kInsertBatch[] =
    "INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)";

constexpr char kPutRevision[] =
    "INSERT OR REPLACE INTO revised_batches (vehicle_key, first_sequence, "
    "count, format, revision, checksum, payload) "
    "VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)";

// Sets the current version of a stored batch.
absl::Status ReviseBatchRow(SqliteDatabase& database, VehicleKey key,
                            const BatchRecord& batch, std::uint64_t revision) {
  {
    SqliteStatement row = database.Prepare(
        "SELECT count FROM batches WHERE vehicle_key = ?1 AND "
        "first_sequence = ?2");
    row.Bind(1, key).Bind(2, Signed(batch.first_sequence));
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found || row.Integer(0) != batch.count) {
      return NoSuchBatch(batch);
    }
  }
  BatchRecord revised = batch;
  revised.revision = revision;
  return WriteBatchRow(database, kPutRevision, key, BatchVersion::kCurrent,
                       revised);
}

}  // namespace

absl::StatusOr<std::optional<BatchRecord>> ReadLastBatch(
    SqliteDatabase& database, VehicleKey key, const std::string& vehicle_id) {
  SqliteStatement row = database.Prepare(
      "SELECT first_sequence, count, format, revision, checksum, payload "
      "FROM batches WHERE vehicle_key = ?1 ORDER BY first_sequence DESC LIMIT "
      "1");
  row.Bind(1, key);
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return std::optional<BatchRecord>();
  absl::StatusOr<BatchRecord> batch =
      CheckedBatch(ReadBatchRow(row, 2, row.Integer(0), row.Integer(1)), key,
                   vehicle_id, BatchVersion::kAsSent);
  if (!batch.ok()) return batch.status();
  return std::optional<BatchRecord>(*std::move(batch));
}

absl::StatusOr<std::uint64_t> ClaimedSequence(SqliteDatabase& database,
                                              VehicleKey key) {
  SqliteStatement row = database.Prepare(
      "SELECT first_sequence, count FROM batches WHERE vehicle_key = ?1 ORDER "
      "BY first_sequence DESC LIMIT 1");
  const absl::StatusOr<bool> found = row.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  if (!*found) return std::uint64_t{0};
  return ClaimedEnd(row.Integer(0), row.Integer(1));
}

absl::Status InsertBatch(SqliteDatabase& database, VehicleKey key,
                         const BatchRecord& batch, std::uint64_t* expected) {
  if (*expected == 0) {
    const absl::StatusOr<std::string> id = VehicleId(database, key);
    if (!id.ok()) return id.status();
    const absl::StatusOr<std::optional<BatchRecord>> last =
        ReadLastBatch(database, key, *id);
    if (!last.ok()) return last.status();
    *expected =
        last->has_value() ? (*last)->first_sequence + (*last)->count : 1;
  }
  if (batch.first_sequence != *expected) {
    const absl::StatusOr<std::string> id = VehicleId(database, key);
    return id.ok() ? SequenceGap(*id, *expected, batch.first_sequence)
                   : id.status();
  }
  const absl::Status status =
      WriteBatchRow(database, kInsertBatch, key, BatchVersion::kAsSent, batch);
  if (status.ok()) *expected += batch.count;
  return status;
}

absl::Status ReviseBatchRows(SqliteDatabase& database, VehicleKey key,
                             const BatchSource& batches,
                             std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  bool is_first = true;
  return batches([&](const BatchRecord& batch) {
    if (std::exchange(is_first, false)) {
      absl::Status forgotten = ForgetSnapshot(database, key);
      if (!forgotten.ok()) return forgotten;
    }
    return ReviseBatchRow(database, key, batch, revision);
  });
}

absl::Status ReplaceBatchRows(SqliteDatabase& database, VehicleKey key,
                              const std::vector<BatchVersions>& batches,
                              std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  if (status.ok()) status = ForgetSnapshot(database, key);
  if (!status.ok()) return status;
  const std::uint64_t first = batches.front().as_sent.first_sequence;
  const BatchRecord& last = batches.back().as_sent;
  const std::uint64_t end = last.first_sequence + last.count;
  {
    // Rows do not overlap, so these hold the range if they hold as many poses.
    SqliteStatement row = database.Prepare(
        "SELECT min(first_sequence), max(first_sequence + count), sum(count) "
        "FROM batches WHERE vehicle_key = ?1 AND first_sequence >= ?2 AND "
        "first_sequence < ?3");
    const absl::StatusOr<bool> found =
        row.Bind(1, key).Bind(2, Signed(first)).Bind(3, Signed(end)).Step();
    if (!found.ok()) return found.status();
    if (row.Integer(0) != Signed(first) || row.Integer(1) != Signed(end) ||
        row.Integer(2) != Signed(end - first)) {
      return NoSuchBatches(first, end - 1);
    }
  }
  for (const char* sql :
       {"DELETE FROM batches WHERE vehicle_key = ?1 AND first_sequence >= ?2 "
        "AND first_sequence < ?3",
        "DELETE FROM revised_batches WHERE vehicle_key = ?1 AND "
        "first_sequence >= ?2 AND first_sequence < ?3"}) {
    status = database.Prepare(sql)
                 .Bind(1, key)
                 .Bind(2, Signed(first))
                 .Bind(3, Signed(end))
                 .Run();
    if (!status.ok()) return status;
  }
  for (const BatchVersions& batch : batches) {
    status = WriteBatchRow(database, kInsertBatch, key, BatchVersion::kAsSent,
                           batch.as_sent);
    if (status.ok() && batch.revised) {
      status = WriteBatchRow(database, kPutRevision, key,
                             BatchVersion::kCurrent, *batch.revised);
    }
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::Status VisitBatches(SqliteDatabase& database, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit) {
  const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  if (first_sequence > last_sequence) return absl::OkStatus();
  SqliteStatement row =
      version == BatchVersion::kAsSent
          ? database.Prepare(
                "SELECT first_sequence, count, format, revision, checksum, "
                "payload FROM batches WHERE vehicle_key = ?1 AND "
                "first_sequence >= (SELECT max(first_sequence) FROM batches "
                "WHERE vehicle_key = ?1 AND first_sequence <= ?2) AND "
                "first_sequence <= ?3 ORDER BY first_sequence")
          : database.Prepare(
                "SELECT b.first_sequence, b.count, b.format, b.revision, "
                "b.checksum, b.payload, r.count, r.format, r.revision, "
                "r.checksum, r.payload FROM batches AS b LEFT JOIN "
                "revised_batches AS r ON r.vehicle_key = b.vehicle_key AND "
                "r.first_sequence = b.first_sequence WHERE b.vehicle_key = "
                "?1 AND b.first_sequence >= (SELECT max(first_sequence) FROM "
                "batches WHERE vehicle_key = ?1 AND first_sequence <= ?2) "
                "AND b.first_sequence <= ?3 ORDER BY b.first_sequence");
  row.Bind(1, key).Bind(2, Signed(first_sequence));
  row.Bind(3, Signed(last_sequence));
  BatchWalk walk(key, *vehicle_id, first_sequence, last_sequence);
  while (!walk.IsDone()) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return walk.Missing();
    std::optional<StoredBatch> revised;
    if (version == BatchVersion::kCurrent && !row.IsNull(6)) {
      revised = ReadBatchRow(row, 7, row.Integer(0), row.Integer(6));
    }
    absl::StatusOr<BatchRecord> batch =
        walk.Next(ReadBatchRow(row, 2, row.Integer(0), row.Integer(1)),
                  std::move(revised));
    if (!batch.ok()) return batch.status();
    if (!visit(*std::move(batch))) break;
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
