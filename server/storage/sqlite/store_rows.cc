#include "server/storage/sqlite/store_rows.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// The statements on the table of a kind of pairs.
struct PairStatements {
  const std::string count;
  const std::string find;
  const std::string insert;
  const std::string remove;
  const std::string remove_all;
  const std::string remove_after;
  const std::string list;

  explicit PairStatements(const std::string& table)
      : count("SELECT count(*) FROM " + table + " WHERE vehicle_key = ?1"),
        find("SELECT 1 FROM " + table + " WHERE vehicle_key = ?1 AND id = ?2"),
        insert("INSERT INTO " + table +
               " (vehicle_key, id, format, query_sequence, matched_sequence, "
               "create_time_ns, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5, "
               "?6, ?7, ?8)"),
        remove("DELETE FROM " + table + " WHERE vehicle_key = ?1 AND id = ?2"),
        remove_all("DELETE FROM " + table + " WHERE vehicle_key = ?1"),
        remove_after("DELETE FROM " + table +
                     " WHERE vehicle_key = ?1 AND max(query_sequence, "
                     "matched_sequence) > ?2"),
        list(
            "SELECT id, format, query_sequence, matched_sequence, "
            "create_time_ns, checksum, payload FROM " +
            table +
            " WHERE vehicle_key = ?1 AND id > ?2 ORDER BY id LIMIT "
            "?3") {}
};

// The statements of pairs of this kind. They live as long as the program,
// because connections cache statements by address.
const PairStatements& StatementsOf(PairKind kind) {
  static const auto& closures = *new PairStatements("loop_closures");
  static const auto& rejections = *new PairStatements("rejected_candidates");
  return kind == PairKind::kLoopClosure ? closures : rejections;
}

// The columns are key, id, format, revision, checksum, payload.
VehicleRecord ReadVehicleRow(const SqliteStatement& row) {
  VehicleRecord record;
  record.key = row.Integer(0);
  record.id = row.Bytes(1);
  const std::int64_t format = row.Integer(2);
  record.revision = Unsigned(row.Integer(3));
  record.payload = row.Bytes(5);
  CheckVehicleRow(format, row.Integer(4), &record);
  return record;
}

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

// Sequence at which the last batch ends according to its row, damaged or not.
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

// Adds the data of other tables to a row of `vehicles`.
absl::Status CompleteVehicle(SqliteDatabase& database, VehicleRecord* record) {
  const absl::StatusOr<std::optional<BatchRecord>> last =
      ReadLastBatch(database, record->key, Printable(record->id));
  if (absl::IsDataLoss(last.status())) {
    if (record->damage.ok()) record->damage = last.status();
    const absl::StatusOr<std::uint64_t> claimed =
        ClaimedSequence(database, record->key);
    if (!claimed.ok()) return claimed.status();
    record->durable_sequence = *claimed;
  } else if (!last.ok()) {
    return last.status();
  } else if (last->has_value()) {
    record->durable_sequence = (*last)->first_sequence + (*last)->count - 1;
    record->revision = std::max(record->revision, (*last)->revision);
  }
  for (const PairKind kind : kPairKinds) {
    SqliteStatement pairs = database.Prepare(StatementsOf(kind).count.c_str());
    const absl::StatusOr<bool> counted = pairs.Bind(1, record->key).Step();
    if (!counted.ok()) return counted.status();
    (kind == PairKind::kLoopClosure ? record->loop_closure_count
                                    : record->rejected_candidate_count) =
        pairs.Integer(0);
  }
  return absl::OkStatus();
}

absl::Status WriteVehicleRow(SqliteDatabase& database,
                             const VehicleRecord& record) {
  return database
      .Prepare(
          "UPDATE vehicles SET format = ?2, revision = ?3, checksum = ?4, "
          "payload = ?5 WHERE key = ?1")
      .Bind(1, record.key)
      .Bind(2, kStoreFormat)
      .Bind(3, Signed(record.revision))
      .Bind(4, ChecksumOfVehicle(kStoreFormat, record))
      .BindBlob(5, record.payload)
      .Run();
}

// Whether pages can be given back, which was decided when the file was made.
absl::StatusOr<bool> CanShrink(SqliteDatabase& database) {
  constexpr std::int64_t kIncremental = 2;
  const absl::StatusOr<std::int64_t> mode =
      database.QueryInteger("PRAGMA auto_vacuum");
  if (!mode.ok()) return mode.status();
  return *mode == kIncremental;
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

// A part of a snapshot takes as much room as so many large batches.
constexpr int kBatchesPerPart = 8;

// The key of the vehicle's snapshot, or of one in the making;
// FAILED_PRECONDITION if there is none.
absl::StatusOr<std::int64_t> SnapshotKey(SqliteDatabase& database,
                                         VehicleKey key) {
  SqliteStatement row =
      database.Prepare("SELECT key FROM snapshots WHERE vehicle_key = ?1");
  const absl::StatusOr<bool> found = row.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  if (!*found) return NoSuchSnapshotPart(0);
  return row.Integer(0);
}

// Begins a snapshot; returns its key.
absl::StatusOr<std::int64_t> InsertSnapshot(SqliteDatabase& database,
                                            VehicleKey key) {
  const absl::Status status =
      database
          .Prepare(
              "INSERT INTO snapshots (vehicle_key, format, last_sequence, "
              "part_count, checksum, payload) VALUES (?1, ?2, 0, 0, 0, x'')")
          .Bind(1, key)
          .Bind(2, kStoreFormat)
          .Run();
  if (!status.ok()) return status;
  return database.LastInsertedKey();
}

// Removes the snapshot of a vehicle, if there is one, and puts its parts out of
// reach.
absl::Status ForgetSnapshot(SqliteDatabase& database, VehicleKey key) {
  const absl::StatusOr<std::int64_t> found = SnapshotKey(database, key);
  if (absl::IsFailedPrecondition(found.status())) return absl::OkStatus();
  if (!found.ok()) return found.status();
  const absl::Status status =
      database.Prepare("DELETE FROM snapshots WHERE key = ?1")
          .Bind(1, *found)
          .Run();
  if (!status.ok()) return status;
  return database.Prepare("INSERT INTO deleted_snapshots (key) VALUES (?1)")
      .Bind(1, *found)
      .Run();
}

// How many of parts [first, end) are kept.
absl::StatusOr<std::uint32_t> CountParts(SqliteDatabase& database,
                                         std::int64_t snapshot,
                                         std::uint32_t first,
                                         std::uint32_t end) {
  SqliteStatement row = database.Prepare(
      "SELECT count(*) FROM snapshot_parts WHERE snapshot_key = ?1 AND number "
      ">= ?2 AND number < ?3");
  const absl::StatusOr<bool> counted =
      row.Bind(1, snapshot).Bind(2, first).Bind(3, end).Step();
  if (!counted.ok()) return counted.status();
  return static_cast<std::uint32_t>(row.Integer(0));
}

// Removes some parts of deleted snapshots; returns whether more may be left.
absl::StatusOr<bool> PurgeSnapshots(SqliteDatabase& database, int parts) {
  std::int64_t key = 0;
  {
    SqliteStatement row =
        database.Prepare("SELECT key FROM deleted_snapshots LIMIT 1");
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return false;
    key = row.Integer(0);
  }
  const absl::Status status =
      database
          .Prepare(
              "DELETE FROM snapshot_parts WHERE rowid IN (SELECT rowid FROM "
              "snapshot_parts WHERE snapshot_key = ?1 LIMIT ?2)")
          .Bind(1, key)
          .Bind(2, parts)
          .Run();
  if (!status.ok()) return status;
  if (database.Changes() > 0) return true;
  const absl::Status removed =
      database.Prepare("DELETE FROM deleted_snapshots WHERE key = ?1")
          .Bind(1, key)
          .Run();
  if (!removed.ok()) return removed;
  return true;
}

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

absl::StatusOr<std::string> VehicleId(SqliteDatabase& database,
                                      VehicleKey key) {
  SqliteStatement row =
      database.Prepare("SELECT id FROM vehicles WHERE key = ?1");
  row.Bind(1, key);
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return UnknownVehicle(key);
  return Printable(row.Bytes(0));
}

absl::StatusOr<VehicleRecord> FindVehicle(SqliteDatabase& database,
                                          const std::string& id) {
  SqliteStatement row = database.Prepare(
      "SELECT key, id, format, revision, checksum, payload FROM vehicles "
      "WHERE id = ?1");
  const absl::StatusOr<bool> found = row.BindText(1, id).Step();
  if (!found.ok()) return found.status();
  if (!*found) return UnknownVehicle("'" + id + "'");
  VehicleRecord record = ReadVehicleRow(row);
  const absl::Status completed = CompleteVehicle(database, &record);
  if (!completed.ok()) return completed;
  return record;
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    SqliteDatabase& database, const std::string& after_id,
    const std::string& prefix, int limit) {
  std::vector<VehicleRecord> records;
  // Ids are ASCII.
  const std::string beyond = prefix + "\x7f";
  SqliteStatement row = database.Prepare(
      "SELECT key, id, format, revision, checksum, payload FROM vehicles "
      "WHERE id > ?1 AND id >= ?2 AND id < ?3 ORDER BY id LIMIT ?4");
  row.BindText(1, after_id).BindText(2, prefix).BindText(3, beyond);
  row.Bind(4, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return records;
    VehicleRecord record = ReadVehicleRow(row);
    const absl::Status completed = CompleteVehicle(database, &record);
    if (!completed.ok()) return completed;
    records.push_back(std::move(record));
  }
}

absl::StatusOr<VehicleKey> InsertVehicle(SqliteDatabase& database,
                                         VehicleRecord record) {
  {
    SqliteStatement taken =
        database.Prepare("SELECT 1 FROM vehicles WHERE id = ?1");
    const absl::StatusOr<bool> found = taken.BindText(1, record.id).Step();
    if (!found.ok()) return found.status();
    if (*found) {
      return VehicleExists(record.id);
    }
  }
  // The checksum covers the key, which is known only now.
  absl::Status status =
      database
          .Prepare(
              "INSERT INTO vehicles (id, format, revision, checksum, payload) "
              "VALUES (?1, 0, 0, 0, x'')")
          .BindText(1, record.id)
          .Run();
  if (!status.ok()) return status;
  record.key = database.LastInsertedKey();
  status = WriteVehicleRow(database, record);
  if (!status.ok()) return status;
  return record.key;
}

absl::Status ImportVehicle(SqliteDatabase& database,
                           const VehicleRecord& record) {
  return database
      .Prepare(
          "INSERT INTO vehicles (key, id, format, revision, checksum, payload) "
          "VALUES (?1, ?2, ?3, ?4, ?5, ?6)")
      .Bind(1, record.key)
      .BindText(2, record.id)
      .Bind(3, kStoreFormat)
      .Bind(4, Signed(record.revision))
      .Bind(5, ChecksumOfVehicle(kStoreFormat, record))
      .BindBlob(6, record.payload)
      .Run();
}

absl::Status ChangeVehicle(SqliteDatabase& database, VehicleKey key,
                           const std::optional<std::string>& payload,
                           std::uint64_t revision) {
  absl::StatusOr<VehicleRecord> record =
      [&]() -> absl::StatusOr<VehicleRecord> {
    SqliteStatement row = database.Prepare(
        "SELECT key, id, format, revision, checksum, payload FROM vehicles "
        "WHERE key = ?1");
    const absl::StatusOr<bool> found = row.Bind(1, key).Step();
    if (!found.ok()) return found.status();
    if (!*found) return UnknownVehicle(key);
    return ReadVehicleRow(row);
  }();
  if (!record.ok()) return record.status();
  // A damaged row that is written again would pass for sound.
  if (!record->damage.ok()) return record->damage;
  if (payload.has_value()) record->payload = *payload;
  record->revision = std::max(record->revision, revision);
  return WriteVehicleRow(database, *record);
}

absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key) {
  absl::Status status = database.Prepare("DELETE FROM vehicles WHERE key = ?1")
                            .Bind(1, key)
                            .Run();
  if (!status.ok()) return status;
  if (database.Changes() == 0) {
    return UnknownVehicle(key);
  }
  status = ForgetSnapshot(database, key);
  if (!status.ok()) return status;
  for (const PairKind kind : kPairKinds) {
    status = database.Prepare(StatementsOf(kind).remove_all.c_str())
                 .Bind(1, key)
                 .Run();
    if (!status.ok()) return status;
  }
  return database.Prepare("INSERT INTO deleted_vehicles (key) VALUES (?1)")
      .Bind(1, key)
      .Run();
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

absl::Status InsertPosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision) {
  const absl::Status status =
      ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  {
    SqliteStatement taken = database.Prepare(StatementsOf(kind).find.c_str());
    const absl::StatusOr<bool> found =
        taken.Bind(1, key).BindText(2, pair.id).Step();
    if (!found.ok()) return found.status();
    if (*found) return PairExists(kind, pair.id);
  }
  return database.Prepare(StatementsOf(kind).insert.c_str())
      .Bind(1, key)
      .BindText(2, pair.id)
      .Bind(3, kStoreFormat)
      .Bind(4, Signed(pair.query_sequence))
      .Bind(5, Signed(pair.matched_sequence))
      .Bind(6, pair.create_time_ns)
      .Bind(7, ChecksumOfPosePair(kStoreFormat, key, kind, pair))
      .BindBlob(8, pair.payload)
      .Run();
}

absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  status = database.Prepare(StatementsOf(kind).remove.c_str())
               .Bind(1, key)
               .BindText(2, id)
               .Run();
  if (!status.ok()) return status;
  return database.Changes() == 0 ? NoSuchPair(kind, id) : absl::OkStatus();
}

absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    SqliteDatabase& database, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit) {
  std::vector<PosePairRecord> pairs;
  const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  SqliteStatement row = database.Prepare(StatementsOf(kind).list.c_str());
  row.Bind(1, key).BindText(2, after_id).Bind(3, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return pairs;
    PosePairRecord pair;
    pair.id = row.Bytes(0);
    const std::int64_t format = row.Integer(1);
    pair.query_sequence = Unsigned(row.Integer(2));
    pair.matched_sequence = Unsigned(row.Integer(3));
    pair.create_time_ns = row.Integer(4);
    // Older rows have none, and their checksums do not cover it.
    if (format >= kPayloadsOfPairsSince) pair.payload = row.Bytes(6);
    CheckPosePairRow(format, row.Integer(5), key, kind, *vehicle_id, &pair);
    pairs.push_back(std::move(pair));
  }
}

absl::Status DropDamagedRows(SqliteDatabase& database, VehicleKey key,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, payload, revision);
  if (!status.ok()) return status;
  bool are_gone = false;
  for (const char* sql :
       {"DELETE FROM batches WHERE vehicle_key = ?1 AND first_sequence > ?2",
        "DELETE FROM revised_batches WHERE vehicle_key = ?1 AND "
        "first_sequence > ?2"}) {
    status =
        database.Prepare(sql).Bind(1, key).Bind(2, Signed(last_sequence)).Run();
    if (!status.ok()) return status;
    are_gone = are_gone || database.Changes() > 0;
  }
  if (are_gone) {
    status = ForgetSnapshot(database, key);
    if (!status.ok()) return status;
  }
  const absl::StatusOr<std::uint64_t> end = ClaimedSequence(database, key);
  if (!end.ok()) return end.status();
  if (*end != last_sequence) {
    return NoBatchEndsAt(last_sequence);
  }
  for (const PairKind kind : kPairKinds) {
    status = database.Prepare(StatementsOf(kind).remove_after.c_str())
                 .Bind(1, key)
                 .Bind(2, Signed(last_sequence))
                 .Run();
    if (!status.ok()) return status;
    // Reads all pairs, without a limit.
    const absl::StatusOr<std::vector<PosePairRecord>> pairs =
        FindPosePairs(database, key, kind, "", std::numeric_limits<int>::max());
    if (!pairs.ok()) return pairs.status();
    for (const PosePairRecord& pair : *pairs) {
      if (pair.damage.ok()) continue;
      status = database.Prepare(StatementsOf(kind).remove.c_str())
                   .Bind(1, key)
                   .BindText(2, pair.id)
                   .Run();
      if (!status.ok()) return status;
    }
  }
  return absl::OkStatus();
}

absl::Status PutSnapshotPartRow(SqliteDatabase& database, VehicleKey key,
                                std::uint32_t number, const std::string& part) {
  const absl::StatusOr<std::string> id = VehicleId(database, key);
  if (!id.ok()) return id.status();
  absl::StatusOr<std::int64_t> snapshot = 0;
  if (number == 0) {
    const absl::Status dropped = ForgetSnapshot(database, key);
    if (!dropped.ok()) return dropped;
    snapshot = InsertSnapshot(database, key);
    if (!snapshot.ok()) return snapshot.status();
  } else {
    snapshot = SnapshotKey(database, key);
    if (!snapshot.ok()) return snapshot.status();
    const absl::StatusOr<std::uint32_t> before =
        CountParts(database, *snapshot, number - 1, number);
    if (!before.ok()) return before.status();
    if (*before == 0) return NoSuchSnapshotPart(number - 1);
  }
  return database
      .Prepare(
          "INSERT OR REPLACE INTO snapshot_parts (snapshot_key, number, "
          "format, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5)")
      .Bind(1, *snapshot)
      .Bind(2, number)
      .Bind(3, kStoreFormat)
      .Bind(4, ChecksumOfSnapshotPart(kStoreFormat, *snapshot, number, part))
      .BindBlob(5, part)
      .Run();
}

absl::Status PutSnapshotRow(SqliteDatabase& database, VehicleKey key,
                            const SnapshotRecord& snapshot) {
  const absl::StatusOr<std::string> id = VehicleId(database, key);
  if (!id.ok()) return id.status();
  absl::StatusOr<std::int64_t> found = SnapshotKey(database, key);
  if (absl::IsFailedPrecondition(found.status()) && snapshot.part_count == 0) {
    found = InsertSnapshot(database, key);
  }
  if (!found.ok()) return found.status();
  const absl::StatusOr<std::uint32_t> kept =
      CountParts(database, *found, 0, snapshot.part_count);
  if (!kept.ok()) return kept.status();
  if (*kept != snapshot.part_count) return NoSuchSnapshotPart(*kept);
  return database
      .Prepare(
          "UPDATE snapshots SET format = ?2, last_sequence = ?3, part_count = "
          "?4, checksum = ?5, payload = ?6 WHERE key = ?1")
      .Bind(1, *found)
      .Bind(2, kStoreFormat)
      .Bind(3, Signed(snapshot.last_sequence))
      .Bind(4, snapshot.part_count)
      .Bind(5, ChecksumOfSnapshot(kStoreFormat, key, snapshot))
      .BindBlob(6, snapshot.payload)
      .Run();
}

absl::Status DropSnapshotRow(SqliteDatabase& database, VehicleKey key) {
  const absl::StatusOr<std::string> id = VehicleId(database, key);
  return id.ok() ? ForgetSnapshot(database, key) : id.status();
}

absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    SqliteDatabase& database, VehicleKey key) {
  SqliteStatement row = database.Prepare(
      "SELECT format, last_sequence, part_count, checksum, payload FROM "
      "snapshots WHERE vehicle_key = ?1 AND last_sequence > 0");
  const absl::StatusOr<bool> found = row.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  if (!*found) return std::optional<SnapshotRecord>();
  SnapshotRecord snapshot;
  snapshot.last_sequence = Unsigned(row.Integer(1));
  snapshot.part_count = static_cast<std::uint32_t>(row.Integer(2));
  snapshot.payload = row.Bytes(4);
  const absl::Status sound =
      CheckSnapshotRow(row.Integer(0), row.Integer(3), key, snapshot);
  if (!sound.ok()) return sound;
  return std::optional<SnapshotRecord>(std::move(snapshot));
}

absl::Status VisitSnapshotParts(
    SqliteDatabase& database, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit) {
  const absl::StatusOr<std::int64_t> snapshot = SnapshotKey(database, key);
  if (!snapshot.ok()) return snapshot.status();
  SqliteStatement row = database.Prepare(
      "SELECT number, format, checksum, payload FROM snapshot_parts WHERE "
      "snapshot_key = ?1 AND number >= ?2 AND number < ?3 ORDER BY number");
  row.Bind(1, *snapshot).Bind(2, first).Bind(3, end);
  for (std::uint32_t number = first; number < end; ++number) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    const absl::string_view part = *found ? row.View(3) : "";
    const absl::Status sound =
        *found && row.Integer(0) == std::int64_t{number}
            ? CheckSnapshotPartRow(row.Integer(1), row.Integer(2), *snapshot,
                                   number, part)
            : MissingSnapshotPart(number);
    if (!sound.ok()) return sound;
    if (!visit(part)) break;
  }
  return absl::OkStatus();
}

absl::StatusOr<bool> PurgeSome(SqliteDatabase& database, int batches) {
  VehicleKey key = 0;
  {
    SqliteStatement row =
        database.Prepare("SELECT key FROM deleted_vehicles LIMIT 1");
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) {
      return PurgeSnapshots(database, std::max(1, batches / kBatchesPerPart));
    }
    key = row.Integer(0);
  }
  int removed = 0;
  for (const char* sql :
       {"DELETE FROM batches WHERE rowid IN (SELECT rowid FROM batches WHERE "
        "vehicle_key = ?1 LIMIT ?2)",
        "DELETE FROM revised_batches WHERE rowid IN (SELECT rowid FROM "
        "revised_batches WHERE vehicle_key = ?1 LIMIT ?2)"}) {
    const absl::Status status =
        database.Prepare(sql).Bind(1, key).Bind(2, batches).Run();
    if (!status.ok()) return status;
    removed += database.Changes();
  }
  if (removed == 0) {
    const absl::Status status =
        database.Prepare("DELETE FROM deleted_vehicles WHERE key = ?1")
            .Bind(1, key)
            .Run();
    if (!status.ok()) return status;
  }
  return true;
}

absl::StatusOr<std::int64_t> GiveBackPages(SqliteDatabase& database,
                                           std::int64_t kept,
                                           std::int64_t most) {
  static constexpr char kFree[] = "PRAGMA freelist_count";
  const absl::StatusOr<bool> shrinks = CanShrink(database);
  if (!shrinks.ok()) return shrinks.status();
  if (!*shrinks) return 0;
  const absl::StatusOr<std::int64_t> before = database.QueryInteger(kFree);
  if (!before.ok()) return before.status();
  if (*before <= kept) return 0;
  const std::int64_t pages = std::min(most, *before - kept);
  const absl::Status status = database.Execute(
      ("PRAGMA incremental_vacuum(" + std::to_string(pages) + ")").c_str());
  if (!status.ok()) return status;
  const absl::StatusOr<std::int64_t> after = database.QueryInteger(kFree);
  if (!after.ok()) return after.status();
  return *before - *after;
}

absl::Status SetShrinking(SqliteDatabase& database) {
  const absl::StatusOr<bool> shrinks = CanShrink(database);
  if (!shrinks.ok() || *shrinks) return shrinks.status();
  return database.Execute("PRAGMA auto_vacuum = INCREMENTAL");
}

}  // namespace revisit::server
