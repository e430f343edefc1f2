#include "server/storage/postgres/postgres_reads.h"

#include <algorithm>
#include <cstddef>
#include <optional>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Batches that one statement reads.
constexpr int kBatchesAtOnce = 64;
// Vehicles that one statement reads, with their last batches.
constexpr std::size_t kVehiclesAtOnce = 1000;

// A vehicle with its head, its last batch and its counts, as of one moment.
#define REVISIT_SELECT_VEHICLE                                           \
  "SELECT v.key, v.id, v.format, v.revision, v.checksum, v.payload, "    \
  "h.durable_sequence, h.revision, "                                     \
  "(SELECT count(*) FROM loop_closures p WHERE p.vehicle_key = v.key), " \
  "(SELECT count(*) FROM rejected_candidates p "                         \
  "WHERE p.vehicle_key = v.key), "                                       \
  "b.first_sequence, b.count, b.format, b.revision, b.checksum, "        \
  "b.payload, h.checks_stored, h.checked_sequence, h.last_event "        \
  "FROM vehicles v LEFT JOIN heads h ON h.key = v.key "                  \
  "LEFT JOIN LATERAL (SELECT * FROM batches WHERE vehicle_key = v.key "  \
  "ORDER BY first_sequence DESC LIMIT 1) b ON true "
constexpr Statement kFindVehicle = {
    "find_vehicle", REVISIT_SELECT_VEHICLE "WHERE v.id = $1::text"};
constexpr Statement kFindVehiclesOf = {
    "find_vehicles_of",
    REVISIT_SELECT_VEHICLE "WHERE v.id = ANY($1::text[]) ORDER BY v.id"};
constexpr Statement kFindVehicles = {
    "find_vehicles", REVISIT_SELECT_VEHICLE
    "WHERE v.id > $1::text AND v.id >= $2::text AND v.id < $3::text "
    "ORDER BY v.id LIMIT $4::int8"};
#undef REVISIT_SELECT_VEHICLE

constexpr Statement kVehicleRows = {
    "vehicle_rows",
    "SELECT key, id, format, revision, checksum, payload FROM vehicles "
    "WHERE key > $1::int8 ORDER BY key LIMIT $2::int8"};
constexpr Statement kVehicleId = {
    "vehicle_id", "SELECT id FROM vehicles WHERE key = $1::int8"};
constexpr Statement kWalkStart = {
    "walk_start",
    "SELECT v.id, (SELECT max(first_sequence) FROM batches "
    "WHERE vehicle_key = $1::int8 AND first_sequence <= $2::int8) "
    "FROM vehicles v WHERE v.key = $1::int8"};
constexpr Statement kBatchesAsSent = {
    "batches_as_sent",
    "SELECT first_sequence, count, format, revision, checksum, payload "
    "FROM batches WHERE vehicle_key = $1::int8 AND "
    "first_sequence >= $2::int8 AND first_sequence <= $3::int8 "
    "ORDER BY first_sequence LIMIT $4::int8"};
constexpr Statement kBatchesCurrent = {
    "batches_current",
    "SELECT b.first_sequence, b.count, b.format, b.revision, b.checksum, "
    "b.payload, r.count, r.format, r.revision, r.checksum, r.payload "
    "FROM batches b LEFT JOIN revised_batches r "
    "ON r.vehicle_key = b.vehicle_key AND r.first_sequence = b.first_sequence "
    "WHERE b.vehicle_key = $1::int8 AND b.first_sequence >= $2::int8 AND "
    "b.first_sequence <= $3::int8 ORDER BY b.first_sequence LIMIT $4::int8"};

#define REVISIT_LIST_PAIRS(TABLE)                                         \
  "SELECT id, format, query_sequence, matched_sequence, create_time_ns, " \
  "checksum, payload FROM " TABLE                                         \
  " WHERE vehicle_key = $1::int8 AND id > $2::text ORDER BY id "          \
  "LIMIT $3::int8"
constexpr Statement kListClosures = {"list_loop_closures",
                                     REVISIT_LIST_PAIRS("loop_closures")};
constexpr Statement kListRejections = {
    "list_rejected_candidates", REVISIT_LIST_PAIRS("rejected_candidates")};
#undef REVISIT_LIST_PAIRS

constexpr Statement kListDeletedPairs = {
    "list_deleted_pairs",
    "SELECT number, kind, id, format, query_sequence, matched_sequence, "
    "create_time_ns, delete_time_ns, checksum, payload FROM "
    "deleted_pose_pairs WHERE vehicle_key = $1::int8 ORDER BY number DESC"};

// The columns from `column` on are count, format, revision, checksum, payload.
StoredBatch BatchAt(const PostgresRows& rows, int row, int column,
                    std::int64_t first_sequence) {
  StoredBatch batch;
  batch.first_sequence = first_sequence;
  batch.count = rows.Integer(row, column);
  batch.format = rows.Integer(row, column + 1);
  batch.revision = rows.Integer(row, column + 2);
  batch.checksum = rows.Integer(row, column + 3);
  batch.payload = rows.Bytes(row, column + 4);
  return batch;
}

absl::Status HeadDamage(const VehicleRecord& record, const std::string& what) {
  return Corrupt("vehicle '" + Printable(record.id) + "': " + what,
                 {{"vehicle", Printable(record.id)}});
}

// The first columns are key, id, format, revision, checksum, payload.
VehicleRecord VehicleRowAt(const PostgresRows& rows, int row) {
  VehicleRecord record;
  record.key = rows.Integer(row, 0);
  record.id = rows.Bytes(row, 1);
  record.revision = Unsigned(rows.Integer(row, 3));
  record.payload = rows.Bytes(row, 5);
  CheckVehicleRow(rows.Integer(row, 2), rows.Integer(row, 4), &record);
  return record;
}

// A row of kFindVehicle.
VehicleRecord VehicleAt(const PostgresRows& rows, int row) {
  VehicleRecord record = VehicleRowAt(rows, row);
  record.loop_closure_count = rows.Integer(row, 8);
  record.rejected_candidate_count = rows.Integer(row, 9);
  record.checks = {rows.Integer(row, 16) != 0, Unsigned(rows.Integer(row, 17)),
                   Unsigned(rows.Integer(row, 18))};
  const std::uint64_t claimed = Unsigned(rows.Integer(row, 6));
  record.durable_sequence = claimed;
  if (record.damage.ok() && rows.IsNull(row, 6)) {
    record.damage = HeadDamage(record, "it has no row in heads");
  }
  // What the head knows counts only with a sound row.
  if (record.damage.ok()) {
    record.revision = std::max(record.revision, Unsigned(rows.Integer(row, 7)));
  }
  std::uint64_t end = 0;
  if (!rows.IsNull(row, 10)) {
    end = ClaimedEnd(rows.Integer(row, 10), rows.Integer(row, 11));
    const absl::Status last =
        CheckedBatch(BatchAt(rows, row, 11, rows.Integer(row, 10)), record.key,
                     Printable(record.id), BatchVersion::kAsSent)
            .status();
    if (record.damage.ok()) record.damage = last;
  }
  if (record.damage.ok() && end != claimed) {
    record.damage = HeadDamage(
        record, "its head is at sequence " + std::to_string(claimed) +
                    ", its last batch ends at " + std::to_string(end));
  }
  // Reading shows what is missing in between.
  record.durable_sequence = std::max(claimed, end);
  return record;
}

void AddVehicles(const PostgresRows& rows,
                 std::vector<VehicleRecord>* records) {
  for (int i = 0; i < rows.size(); ++i) records->push_back(VehicleAt(rows, i));
}

// All reads of one moment.
class Snapshot {
 public:
  explicit Snapshot(PostgresConnection& connection)
      : connection_(connection),
        status_(connection
                    .RunText("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
                    .status()) {}
  ~Snapshot() {
    if (status_.ok()) connection_.RunText("COMMIT").IgnoreError();
  }
  Snapshot(const Snapshot&) = delete;
  Snapshot& operator=(const Snapshot&) = delete;

  const absl::Status& status() const { return status_; }

 private:
  PostgresConnection& connection_;
  const absl::Status status_;
};

}  // namespace

absl::StatusOr<std::string> VehicleId(PostgresConnection& connection,
                                      VehicleKey key) {
  const auto rows = connection.Run(kVehicleId, Parameters().Add(key));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle(key);
  return Printable(rows->Bytes(0, 0));
}

absl::StatusOr<VehicleRecord> FindVehicle(PostgresConnection& connection,
                                          const std::string& id) {
  const auto rows = connection.Run(kFindVehicle, Parameters().AddText(id));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle("'" + id + "'");
  return VehicleAt(*rows, 0);
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehiclesOf(
    PostgresConnection& connection, const std::set<std::string>& ids) {
  std::vector<VehicleRecord> records;
  for (auto id = ids.begin(); id != ids.end();) {
    std::vector<const std::string*> some;
    while (id != ids.end() && some.size() < kVehiclesAtOnce) {
      some.push_back(&*id++);
    }
    const auto rows =
        connection.Run(kFindVehiclesOf, Parameters().AddTexts(some));
    if (!rows.ok()) return rows.status();
    AddVehicles(*rows, &records);
  }
  return records;
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit) {
  const auto rows =
      connection.Run(kFindVehicles, Parameters()
                                        .AddText(after_id)
                                        .AddText(prefix)
                                        .AddText(BeyondPrefix(prefix))
                                        .Add(std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  std::vector<VehicleRecord> records;
  AddVehicles(*rows, &records);
  return records;
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehicleRows(
    PostgresConnection& connection, VehicleKey after_key, int limit) {
  const auto rows = connection.Run(
      kVehicleRows,
      Parameters().Add(after_key).Add(std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  std::vector<VehicleRecord> records;
  for (int i = 0; i < rows->size(); ++i) {
    records.push_back(VehicleRowAt(*rows, i));
  }
  return records;
}

absl::Status VisitBatches(PostgresConnection& connection, VehicleKey key,
                          std::uint64_t first_sequence,
                          std::uint64_t last_sequence, BatchVersion version,
                          const std::function<bool(BatchRecord)>& visit) {
  const Snapshot snapshot(connection);
  if (!snapshot.status().ok()) return snapshot.status();
  const auto start = connection.Run(
      kWalkStart, Parameters().Add(key).Add(Signed(first_sequence)));
  if (!start.ok()) return start.status();
  if (start->size() == 0) return UnknownVehicle(key);
  if (first_sequence > last_sequence) return absl::OkStatus();
  const bool current = version == BatchVersion::kCurrent;
  BatchWalk walk(key, Printable(start->Bytes(0, 0)), first_sequence,
                 last_sequence);
  if (start->IsNull(0, 1)) return walk.Missing();
  std::int64_t next = start->Integer(0, 1);
  while (!walk.IsDone()) {
    const auto rows = connection.Run(current ? kBatchesCurrent : kBatchesAsSent,
                                     Parameters()
                                         .Add(key)
                                         .Add(next)
                                         .Add(Signed(last_sequence))
                                         .Add(std::int64_t{kBatchesAtOnce}));
    if (!rows.ok()) return rows.status();
    if (rows->size() == 0) return walk.Missing();
    for (int i = 0; i < rows->size() && !walk.IsDone(); ++i) {
      const std::int64_t first = rows->Integer(i, 0);
      std::optional<StoredBatch> revised;
      if (current && !rows->IsNull(i, 6)) {
        revised = BatchAt(*rows, i, 6, first);
      }
      absl::StatusOr<BatchRecord> batch =
          walk.Next(BatchAt(*rows, i, 1, first), std::move(revised));
      if (!batch.ok()) return batch.status();
      if (!visit(*std::move(batch))) return absl::OkStatus();
      next = first + 1;
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<std::vector<PosePairRecord>> FindPosePairs(
    PostgresConnection& connection, VehicleKey key, PairKind kind,
    const std::string& after_id, int limit) {
  const absl::StatusOr<std::string> vehicle_id = VehicleId(connection, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  const auto rows = connection.Run(
      kind == PairKind::kLoopClosure ? kListClosures : kListRejections,
      Parameters().Add(key).AddText(after_id).Add(
          std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  std::vector<PosePairRecord> pairs;
  for (int i = 0; i < rows->size(); ++i) {
    PosePairRecord pair;
    pair.id = rows->Bytes(i, 0);
    pair.query_sequence = Unsigned(rows->Integer(i, 2));
    pair.matched_sequence = Unsigned(rows->Integer(i, 3));
    pair.create_time_ns = rows->Integer(i, 4);
    pair.payload = rows->Bytes(i, 6);
    CheckPosePairRow(rows->Integer(i, 1), rows->Integer(i, 5), key, kind,
                     *vehicle_id, &pair);
    pairs.push_back(std::move(pair));
  }
  return pairs;
}

absl::StatusOr<std::vector<DeletedPairRecord>> FindDeletedPairs(
    PostgresConnection& connection, VehicleKey key) {
  const absl::StatusOr<std::string> vehicle_id = VehicleId(connection, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  std::vector<DeletedPairRecord> all;
  const auto rows = connection.Run(kListDeletedPairs, Parameters().Add(key));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) {
    DeletedPairRecord deleted;
    deleted.number = Unsigned(rows->Integer(i, 0));
    deleted.pair.id = rows->Bytes(i, 2);
    deleted.pair.query_sequence = Unsigned(rows->Integer(i, 4));
    deleted.pair.matched_sequence = Unsigned(rows->Integer(i, 5));
    deleted.pair.create_time_ns = rows->Integer(i, 6);
    deleted.delete_time_ns = rows->Integer(i, 7);
    deleted.pair.payload = rows->Bytes(i, 9);
    CheckDeletedPairRow(rows->Integer(i, 3), rows->Integer(i, 8), key,
                        rows->Integer(i, 1), *vehicle_id, &deleted);
    all.push_back(std::move(deleted));
  }
  return all;
}

}  // namespace revisit::server
