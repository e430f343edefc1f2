#include "server/storage/sqlite/snapshot_rows.h"

#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

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

// The key of the vehicle's snapshot, which is begun where there is none.
absl::StatusOr<std::int64_t> SnapshotKeyOrNew(SqliteDatabase& database,
                                              VehicleKey key) {
  const absl::StatusOr<std::int64_t> found = SnapshotKey(database, key);
  return absl::IsFailedPrecondition(found.status())
             ? InsertSnapshot(database, key)
             : found;
}

absl::Status PutPart(SqliteDatabase& database, std::int64_t snapshot,
                     std::uint32_t number, const std::string& part) {
  return database
      .Prepare(
          "INSERT OR REPLACE INTO snapshot_parts (snapshot_key, number, "
          "format, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5)")
      .Bind(1, snapshot)
      .Bind(2, number)
      .Bind(3, kStoreFormat)
      .Bind(4, ChecksumOfSnapshotPart(kStoreFormat, snapshot, number, part))
      .BindBlob(5, part)
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

}  // namespace

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
  return PutPart(database, *snapshot, number, part);
}

absl::Status PutSnapshotRow(SqliteDatabase& database, VehicleKey key,
                            const SnapshotRecord& snapshot) {
  const absl::StatusOr<std::string> id = VehicleId(database, key);
  if (!id.ok()) return id.status();
  const absl::StatusOr<std::int64_t> found =
      snapshot.part_count == 0 ? SnapshotKeyOrNew(database, key)
                               : SnapshotKey(database, key);
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

absl::Status PutMarksRow(SqliteDatabase& database, VehicleKey key,
                         const std::string& marks) {
  const absl::StatusOr<std::string> id = VehicleId(database, key);
  if (!id.ok()) return id.status();
  const absl::StatusOr<std::int64_t> snapshot = SnapshotKeyOrNew(database, key);
  if (!snapshot.ok()) return snapshot.status();
  return PutPart(database, *snapshot, kMarksPart, marks);
}

absl::StatusOr<std::optional<std::string>> FindMarks(SqliteDatabase& database,
                                                     VehicleKey key) {
  SqliteStatement row = database.Prepare(
      "SELECT s.key, p.format, p.checksum, p.payload FROM snapshots s JOIN "
      "snapshot_parts p ON p.snapshot_key = s.key AND p.number = ?2 WHERE "
      "s.vehicle_key = ?1");
  const absl::StatusOr<bool> found =
      row.Bind(1, key).Bind(2, kMarksPart).Step();
  if (!found.ok()) return found.status();
  if (!*found) return std::optional<std::string>();
  std::string marks = row.Bytes(3);
  const absl::Status sound =
      CheckMarksRow(row.Integer(1), row.Integer(2), row.Integer(0), marks);
  if (!sound.ok()) return sound;
  return std::optional<std::string>(std::move(marks));
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

}  // namespace revisit::server
