#include "server/storage/sqlite/pair_rows.h"

#include <algorithm>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/vehicle_rows.h"

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

// The number for the next pair of the vehicle that is deleted.
absl::StatusOr<std::uint64_t> NextNumber(SqliteDatabase& database,
                                         VehicleKey key) {
  SqliteStatement last = database.Prepare(
      "SELECT coalesce(max(number), 0) FROM deleted_pose_pairs WHERE "
      "vehicle_key = ?1");
  const absl::StatusOr<bool> found = last.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  return NumberAfter(last.Integer(0));
}

absl::Status RemoveAllDeletedPairs(SqliteDatabase& database, VehicleKey key) {
  return database
      .Prepare("DELETE FROM deleted_pose_pairs WHERE vehicle_key = ?1")
      .Bind(1, key)
      .Run();
}

// Removes those behind the last kMostDeletedPairs.
absl::Status RemoveOldDeletedPairs(SqliteDatabase& database, VehicleKey key) {
  return database
      .Prepare(
          "DELETE FROM deleted_pose_pairs WHERE vehicle_key = ?1 AND number "
          "<= (SELECT number FROM deleted_pose_pairs WHERE vehicle_key = ?1 "
          "ORDER BY number DESC LIMIT 1 OFFSET ?2)")
      .Bind(1, key)
      .Bind(2, kMostDeletedPairs)
      .Run();
}

absl::Status RemoveDamagedDeletedPairs(SqliteDatabase& database,
                                       VehicleKey key) {
  const auto all = FindDeletedPairs(database, key);
  if (!all.ok()) return all.status();
  for (const DeletedPairRecord& deleted : *all) {
    if (deleted.pair.damage.ok()) continue;
    const absl::Status status =
        database
            .Prepare(
                "DELETE FROM deleted_pose_pairs WHERE vehicle_key = ?1 AND "
                "number = ?2")
            .Bind(1, key)
            .Bind(2, Signed(deleted.number))
            .Run();
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::int64_t> CountPosePairs(SqliteDatabase& database,
                                            VehicleKey key, PairKind kind) {
  SqliteStatement pairs = database.Prepare(StatementsOf(kind).count.c_str());
  const absl::StatusOr<bool> counted = pairs.Bind(1, key).Step();
  if (!counted.ok()) return counted.status();
  return pairs.Integer(0);
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
                            DeletedPairRecord deleted, std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  status = database.Prepare(StatementsOf(deleted.kind).remove.c_str())
               .Bind(1, key)
               .BindText(2, deleted.pair.id)
               .Run();
  if (!status.ok()) return status;
  if (database.Changes() == 0) return NoSuchPair(deleted.kind, deleted.pair.id);
  const absl::StatusOr<std::uint64_t> number = NextNumber(database, key);
  if (!number.ok()) return number.status();
  deleted.number = *number;
  status = InsertDeletedPair(database, key, deleted);
  return status.ok() ? RemoveOldDeletedPairs(database, key) : status;
}

absl::Status InsertDeletedPair(SqliteDatabase& database, VehicleKey key,
                               const DeletedPairRecord& deleted) {
  return database
      .Prepare(
          "INSERT INTO deleted_pose_pairs (vehicle_key, number, kind, id, "
          "format, query_sequence, matched_sequence, create_time_ns, "
          "delete_time_ns, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6, "
          "?7, ?8, ?9, ?10, ?11)")
      .Bind(1, key)
      .Bind(2, Signed(deleted.number))
      .Bind(3, NumberOf(deleted.kind))
      .BindText(4, deleted.pair.id)
      .Bind(5, kStoreFormat)
      .Bind(6, Signed(deleted.pair.query_sequence))
      .Bind(7, Signed(deleted.pair.matched_sequence))
      .Bind(8, deleted.pair.create_time_ns)
      .Bind(9, deleted.delete_time_ns)
      .Bind(10, ChecksumOfDeletedPair(kStoreFormat, key, deleted))
      .BindBlob(11, deleted.pair.payload)
      .Run();
}

absl::Status RemovePosePairs(SqliteDatabase& database, VehicleKey key) {
  for (const PairKind kind : kPairKinds) {
    const absl::Status status =
        database.Prepare(StatementsOf(kind).remove_all.c_str())
            .Bind(1, key)
            .Run();
    if (!status.ok()) return status;
  }
  return RemoveAllDeletedPairs(database, key);
}

absl::Status RemoveDamagedPosePairs(SqliteDatabase& database, VehicleKey key,
                                    std::uint64_t last_sequence) {
  for (const PairKind kind : kPairKinds) {
    absl::Status status =
        database.Prepare(StatementsOf(kind).remove_after.c_str())
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
  return RemoveDamagedDeletedPairs(database, key);
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
    pair.payload = row.Bytes(6);
    CheckPosePairRow(format, row.Integer(5), key, kind, *vehicle_id, &pair);
    pairs.push_back(std::move(pair));
  }
}

absl::StatusOr<std::vector<DeletedPairRecord>> FindDeletedPairs(
    SqliteDatabase& database, VehicleKey key) {
  std::vector<DeletedPairRecord> all;
  const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  SqliteStatement row = database.Prepare(
      "SELECT number, kind, id, format, query_sequence, matched_sequence, "
      "create_time_ns, delete_time_ns, checksum, payload FROM "
      "deleted_pose_pairs WHERE vehicle_key = ?1 ORDER BY number DESC");
  row.Bind(1, key);
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return all;
    DeletedPairRecord deleted;
    deleted.number = Unsigned(row.Integer(0));
    deleted.pair.id = row.Bytes(2);
    deleted.pair.query_sequence = Unsigned(row.Integer(4));
    deleted.pair.matched_sequence = Unsigned(row.Integer(5));
    deleted.pair.create_time_ns = row.Integer(6);
    deleted.delete_time_ns = row.Integer(7);
    deleted.pair.payload = row.Bytes(9);
    CheckDeletedPairRow(row.Integer(3), row.Integer(8), key, row.Integer(1),
                        *vehicle_id, &deleted);
    all.push_back(std::move(deleted));
  }
}

}  // namespace revisit::server
