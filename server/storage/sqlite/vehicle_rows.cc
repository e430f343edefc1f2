#include "server/storage/sqlite/vehicle_rows.h"

#include <algorithm>
#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/check_rows.h"
#include "server/storage/sqlite/group_rows.h"
#include "server/storage/sqlite/pair_rows.h"
#include "server/storage/sqlite/snapshot_rows.h"

namespace revisit::server {
namespace {

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
    const absl::StatusOr<std::int64_t> count =
        CountPosePairs(database, record->key, kind);
    if (!count.ok()) return count.status();
    (kind == PairKind::kLoopClosure ? record->loop_closure_count
                                    : record->rejected_candidate_count) =
        *count;
  }
  const absl::StatusOr<ChecksHead> checks =
      FindChecksHead(database, record->key);
  if (checks.ok()) {
    record->checks = *checks;
  } else if (!absl::IsDataLoss(checks.status())) {
    return checks.status();
  } else if (record->damage.ok()) {
    record->damage = checks.status();
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

// One after the other, since no trip to another machine is saved.
absl::StatusOr<std::vector<VehicleRecord>> FindVehiclesOf(
    SqliteDatabase& database, const std::set<std::string>& ids) {
  std::vector<VehicleRecord> records;
  for (const std::string& id : ids) {
    absl::StatusOr<VehicleRecord> record = FindVehicle(database, id);
    if (record.ok()) {
      records.push_back(*std::move(record));
    } else if (!absl::IsNotFound(record.status())) {
      return record.status();
    }
  }
  return records;
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    SqliteDatabase& database, const std::string& after_id,
    const std::string& prefix, int limit) {
  std::vector<VehicleRecord> records;
  const std::string beyond = BeyondPrefix(prefix);
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

absl::StatusOr<std::vector<VehicleRecord>> FindVehicleRows(
    SqliteDatabase& database, VehicleKey after_key, int limit) {
  std::vector<VehicleRecord> records;
  SqliteStatement row = database.Prepare(
      "SELECT key, id, format, revision, checksum, payload FROM vehicles "
      "WHERE key > ?1 ORDER BY key LIMIT ?2");
  row.Bind(1, after_key).Bind(2, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return records;
    records.push_back(ReadVehicleRow(row));
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
  status = DropDamagedChecks(database, key, last_sequence);
  if (!status.ok()) return status;
  status = CutLinks(database, key, last_sequence);
  if (!status.ok()) return status;
  return RemoveDamagedPosePairs(database, key, last_sequence);
}

absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key,
                           const EventRecord& farewell) {
  absl::Status status = database.Prepare("DELETE FROM vehicles WHERE key = ?1")
                            .Bind(1, key)
                            .Run();
  if (!status.ok()) return status;
  if (database.Changes() == 0) {
    return UnknownVehicle(key);
  }
  status = ForgetSnapshot(database, key);
  if (!status.ok()) return status;
  status = RemovePosePairs(database, key);
  if (!status.ok()) return status;
  status = RemoveChecks(database, key, farewell);
  if (!status.ok()) return status;
  status = LeaveGroups(database, key);
  if (!status.ok()) return status;
  return database.Prepare("INSERT INTO deleted_vehicles (key) VALUES (?1)")
      .Bind(1, key)
      .Run();
}

}  // namespace revisit::server
