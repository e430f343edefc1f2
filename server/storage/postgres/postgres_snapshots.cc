#include "server/storage/postgres/postgres_snapshots.h"

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Parts that one statement reads, some megabytes.
constexpr std::int64_t kPartsAtOnce = 4;

// The claim is compared under a lock of the head, which keeps another server
// from taking the vehicle until the statement is committed, but the head is
// left as it is.
#define REVISIT_SNAPSHOT_FENCE                                 \
  "WITH h AS (SELECT key FROM heads WHERE " REVISIT_HEAD_HOLDS \
  " FOR NO KEY UPDATE) "
// $5 snapshot, $6 number, $7 format, $8 checksum, $9 payload.
#define REVISIT_INSERT_PART                                              \
  "INSERT INTO snapshot_parts (snapshot_key, number, format, checksum, " \
  "payload) SELECT s.key, $6::int8, $7::int8, $8::int8, $9::bytea FROM s "

constexpr Statement kNextSnapshot = {
    "next_snapshot",
    "SELECT nextval(pg_get_serial_sequence('snapshots', 'key')::regclass)"};
#define REVISIT_OR_REPLACE_PART                    \
  "ON CONFLICT (snapshot_key, number) DO UPDATE "  \
  "SET format = excluded.format, checksum = "      \
  "excluded.checksum, payload = excluded.payload " \
  "RETURNING snapshot_key"
// Begins a snapshot, of which there is no part yet.
#define REVISIT_BEGIN_SNAPSHOT(AFTER)                                      \
  ", s AS (INSERT INTO snapshots (key, vehicle_key, format, "              \
  "last_sequence, part_count, checksum, payload) SELECT $5::int8, h.key, " \
  "$7::int8, 0, 0, 0, '' FROM h " AFTER "RETURNING key) "
// The snapshot before is gone when the new one comes, because its row is passed
// on.
constexpr Statement kPutFirstPart = {
    "put_first_snapshot_part",
    REVISIT_SNAPSHOT_FENCE REVISIT_FORGET_SNAPSHOT REVISIT_BEGIN_SNAPSHOT(
        "LEFT JOIN d ON true ") REVISIT_INSERT_PART "RETURNING snapshot_key"};
constexpr Statement kPutPart = {
    "put_snapshot_part", REVISIT_SNAPSHOT_FENCE
    ", s AS (SELECT t.key FROM h JOIN snapshots t ON t.vehicle_key = h.key "
    "JOIN snapshot_parts p ON p.snapshot_key = t.key AND "
    "p.number = $6::int8 - 1 WHERE t.key = $5::int8) " REVISIT_INSERT_PART
        REVISIT_OR_REPLACE_PART};
constexpr Statement kPutFirstMarks = {
    "put_first_marks", REVISIT_SNAPSHOT_FENCE REVISIT_BEGIN_SNAPSHOT("")
                           REVISIT_INSERT_PART "RETURNING snapshot_key"};
constexpr Statement kPutMarks = {
    "put_marks", REVISIT_SNAPSHOT_FENCE
    ", s AS (SELECT t.key FROM h JOIN snapshots t ON t.vehicle_key = h.key "
    "WHERE t.key = $5::int8) " REVISIT_INSERT_PART REVISIT_OR_REPLACE_PART};
#undef REVISIT_BEGIN_SNAPSHOT
#undef REVISIT_OR_REPLACE_PART
#undef REVISIT_INSERT_PART

// $5 format, $6 last sequence, $7 number of parts, $8 checksum, $9 payload.
constexpr Statement kPutSnapshot = {
    "put_snapshot", REVISIT_SNAPSHOT_FENCE
    "INSERT INTO snapshots AS t (vehicle_key, format, last_sequence, "
    "part_count, checksum, payload) SELECT h.key, $5::int8, $6::int8, "
    "$7::int8, $8::int8, $9::bytea FROM h WHERE $7::int8 = (SELECT count(*) "
    "FROM snapshots s JOIN snapshot_parts p ON p.snapshot_key = s.key "
    "WHERE s.vehicle_key = h.key AND p.number < $7::int8) "
    "ON CONFLICT (vehicle_key) DO UPDATE SET format = excluded.format, "
    "last_sequence = excluded.last_sequence, "
    "part_count = excluded.part_count, checksum = excluded.checksum, "
    "payload = excluded.payload RETURNING t.key"};
constexpr Statement kDropSnapshot = {
    "drop_snapshot",
    REVISIT_SNAPSHOT_FENCE REVISIT_FORGET_SNAPSHOT "SELECT key FROM h"};
#undef REVISIT_SNAPSHOT_FENCE
// $1 vehicle.
constexpr Statement kForgetSnapshot = {
    "forget_snapshot",
    "WITH h AS (SELECT $1::int8 AS key) " REVISIT_FORGET_SNAPSHOT
    "SELECT key FROM d"};

constexpr Statement kSnapshotKey = {
    "snapshot_key",
    "SELECT (SELECT s.key FROM snapshots s WHERE s.vehicle_key = v.key), "
    "(SELECT count(*) FROM snapshots s JOIN snapshot_parts p ON "
    "p.snapshot_key = s.key WHERE s.vehicle_key = v.key AND p.number < "
    "$2::int8) FROM vehicles v WHERE v.key = $1::int8"};
constexpr Statement kFindMarks = {
    "find_marks",
    "SELECT s.key, p.format, p.checksum, p.payload FROM snapshots s JOIN "
    "snapshot_parts p ON p.snapshot_key = s.key AND p.number = $2::int8 "
    "WHERE s.vehicle_key = $1::int8"};
constexpr Statement kFindSnapshot = {
    "find_snapshot",
    "SELECT format, last_sequence, part_count, checksum, payload "
    "FROM snapshots WHERE vehicle_key = $1::int8 AND last_sequence > 0"};
constexpr Statement kSnapshotParts = {
    "snapshot_parts",
    "SELECT number, format, checksum, payload FROM snapshot_parts "
    "WHERE snapshot_key = $1::int8 AND number >= $2::int8 AND "
    "number < $3::int8 ORDER BY number LIMIT $4::int8"};

// As in postgres_changes.cc, a row of `deleted_snapshots` goes in the statement
// after the one that removed its last part.
constexpr Statement kPurgeSnapshots = {
    "purge_snapshots",
    "WITH d AS (SELECT key FROM deleted_snapshots ORDER BY key LIMIT 1 "
    "FOR UPDATE SKIP LOCKED), "
    "p AS (DELETE FROM snapshot_parts WHERE (snapshot_key, number) IN "
    "(SELECT t.snapshot_key, t.number FROM d JOIN snapshot_parts t "
    "ON t.snapshot_key = d.key ORDER BY t.number LIMIT 4)), "
    "e AS (DELETE FROM deleted_snapshots x USING d WHERE x.key = d.key AND "
    "NOT EXISTS (SELECT 1 FROM snapshot_parts WHERE snapshot_key = d.key)) "
    "SELECT key FROM d"};

// A snapshot, or one in the making.
struct SnapshotKey {
  std::int64_t key = 0;
  std::uint32_t parts = 0;
};

// FAILED_PRECONDITION if the vehicle has none.
absl::StatusOr<SnapshotKey> FindSnapshotKey(PostgresConnection& connection,
                                            VehicleKey key) {
  const auto rows = connection.Run(
      kSnapshotKey, Parameters().Add(key).Add(std::int64_t{kMarksPart}));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle(key);
  if (rows->IsNull(0, 0)) return NoSuchSnapshotPart(0);
  return SnapshotKey{rows->Integer(0, 0),
                     static_cast<std::uint32_t>(rows->Integer(0, 1))};
}

// The key of a snapshot that begins.
absl::StatusOr<SnapshotKey> NextSnapshotKey(PostgresConnection& connection) {
  const auto next = connection.Run(kNextSnapshot);
  if (!next.ok()) return next.status();
  return SnapshotKey{next->Integer(0, 0), 0};
}

// Runs a statement that writes a part of the snapshot, whose key its checksum
// covers. `otherwise`: why it writes nothing where the fence holds.
absl::Status PutPart(PostgresConnection& connection, const Statement& statement,
                     const Fence& fence,
                     const absl::StatusOr<SnapshotKey>& snapshot,
                     std::uint32_t number, const std::string& part,
                     const absl::Status& otherwise) {
  if (!snapshot.ok()) return snapshot.status();
  const auto rows = connection.Run(
      statement, FenceOf(fence)
                     .Add(snapshot->key)
                     .Add(std::int64_t{number})
                     .Add(kSharedRowFormat)
                     .Add(ChecksumOfSnapshotPart(kSharedRowFormat,
                                                 snapshot->key, number, part))
                     .AddText(part));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, otherwise);
}

}  // namespace

absl::Status PutSnapshotPartRow(PostgresConnection& connection,
                                const Fence& fence, std::uint32_t number,
                                const std::string& part) {
  if (number == 0) {
    return PutPart(connection, kPutFirstPart, fence,
                   NextSnapshotKey(connection), number, part,
                   Fenced("the vehicle"));
  }
  return PutPart(connection, kPutPart, fence,
                 FindSnapshotKey(connection, fence.key), number, part,
                 NoSuchSnapshotPart(number - 1));
}

absl::Status PutMarksRow(PostgresConnection& connection, const Fence& fence,
                         const std::string& marks) {
  auto snapshot = FindSnapshotKey(connection, fence.key);
  const bool is_first = absl::IsFailedPrecondition(snapshot.status());
  if (is_first) snapshot = NextSnapshotKey(connection);
  return PutPart(connection, is_first ? kPutFirstMarks : kPutMarks, fence,
                 snapshot, kMarksPart, marks, Fenced("the vehicle"));
}

absl::Status PutSnapshotRow(PostgresConnection& connection, const Fence& fence,
                            const SnapshotRecord& snapshot) {
  const auto rows = connection.Run(
      kPutSnapshot,
      FenceOf(fence)
          .Add(kSharedRowFormat)
          .Add(Signed(snapshot.last_sequence))
          .Add(std::int64_t{snapshot.part_count})
          .Add(ChecksumOfSnapshot(kSharedRowFormat, fence.key, snapshot))
          .AddText(snapshot.payload));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  const auto kept = FindSnapshotKey(connection, fence.key);
  if (!kept.ok() && !absl::IsFailedPrecondition(kept.status())) {
    return kept.status();
  }
  return WhyNotWritten(connection, fence,
                       NoSuchSnapshotPart(kept.ok() ? kept->parts : 0));
}

absl::Status DropSnapshotRow(PostgresConnection& connection,
                             const Fence& fence) {
  const auto rows = connection.Run(kDropSnapshot, FenceOf(fence));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status ForgetSnapshot(PostgresConnection& connection, VehicleKey key) {
  return connection.Run(kForgetSnapshot, Parameters().Add(key)).status();
}

absl::StatusOr<bool> PurgeSnapshots(PostgresConnection& connection) {
  const auto rows = connection.Run(kPurgeSnapshots);
  if (!rows.ok()) return rows.status();
  return rows->size() > 0;
}

absl::StatusOr<std::optional<SnapshotRecord>> FindSnapshot(
    PostgresConnection& connection, VehicleKey key) {
  const auto rows = connection.Run(kFindSnapshot, Parameters().Add(key));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return std::optional<SnapshotRecord>();
  SnapshotRecord snapshot;
  snapshot.last_sequence = Unsigned(rows->Integer(0, 1));
  snapshot.part_count = static_cast<std::uint32_t>(rows->Integer(0, 2));
  snapshot.payload = rows->Bytes(0, 4);
  const absl::Status sound =
      CheckSnapshotRow(rows->Integer(0, 0), rows->Integer(0, 3), key, snapshot);
  if (!sound.ok()) return sound;
  return std::optional<SnapshotRecord>(std::move(snapshot));
}

absl::StatusOr<std::optional<std::string>> FindMarks(
    PostgresConnection& connection, VehicleKey key) {
  const auto rows = connection.Run(
      kFindMarks, Parameters().Add(key).Add(std::int64_t{kMarksPart}));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return std::optional<std::string>();
  const absl::Status sound =
      CheckMarksRow(rows->Integer(0, 1), rows->Integer(0, 2),
                    rows->Integer(0, 0), rows->View(0, 3));
  if (!sound.ok()) return sound;
  return std::optional<std::string>(rows->Bytes(0, 3));
}

absl::Status VisitSnapshotParts(
    PostgresConnection& connection, VehicleKey key, std::uint32_t first,
    std::uint32_t end, const std::function<bool(absl::string_view)>& visit) {
  const auto snapshot = FindSnapshotKey(connection, key);
  if (!snapshot.ok()) return snapshot.status();
  while (first < end) {
    const auto rows =
        connection.Run(kSnapshotParts, Parameters()
                                           .Add(snapshot->key)
                                           .Add(std::int64_t{first})
                                           .Add(std::int64_t{end})
                                           .Add(kPartsAtOnce));
    if (!rows.ok()) return rows.status();
    if (rows->size() == 0) return MissingSnapshotPart(first);
    for (int i = 0; i < rows->size(); ++i, ++first) {
      if (rows->Integer(i, 0) != std::int64_t{first}) {
        return MissingSnapshotPart(first);
      }
      const absl::string_view part = rows->View(i, 3);
      const absl::Status sound = CheckSnapshotPartRow(
          rows->Integer(i, 1), rows->Integer(i, 2), snapshot->key, first, part);
      if (!sound.ok()) return sound;
      if (!visit(part)) return absl::OkStatus();
    }
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
