#include "server/storage/postgres/postgres_rows.h"

#include <algorithm>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Batches that one statement reads, or revises.
constexpr int kBatchesAtOnce = 64;
constexpr std::size_t kRevisedBytesAtOnce = std::size_t{4} << 20;

// A vehicle with its head, its last batch and its counts, as of one moment.
#define REVISIT_SELECT_VEHICLE                                              \
  "SELECT v.key, v.id, v.format, v.revision, v.checksum, v.payload, "       \
  "h.durable_sequence, h.revision, "                                        \
  "(SELECT count(*) FROM loop_closures p WHERE p.vehicle_key = v.key), "    \
  "(SELECT count(*) FROM rejected_candidates p "                            \
  "WHERE p.vehicle_key = v.key), "                                          \
  "b.first_sequence, b.count, b.format, b.revision, b.checksum, b.payload " \
  "FROM vehicles v LEFT JOIN heads h ON h.key = v.key "                     \
  "LEFT JOIN LATERAL (SELECT * FROM batches WHERE vehicle_key = v.key "     \
  "ORDER BY first_sequence DESC LIMIT 1) b ON true "
constexpr Statement kFindVehicle = {
    "find_vehicle", REVISIT_SELECT_VEHICLE "WHERE v.id = $1::text"};
constexpr Statement kFindVehicles = {
    "find_vehicles", REVISIT_SELECT_VEHICLE
    "WHERE v.id > $1::text AND v.id >= $2::text AND v.id < $3::text "
    "ORDER BY v.id LIMIT $4::int8"};
#undef REVISIT_SELECT_VEHICLE

constexpr Statement kVehicleRow = {
    "vehicle_row",
    "SELECT id, format, revision, checksum, payload FROM vehicles "
    "WHERE key = $1::int8"};
constexpr Statement kHeadRows = {
    "head_rows",
    "SELECT key, owner, epoch, durable_sequence FROM heads "
    "WHERE key = ANY($1::int8[])"};
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

constexpr Statement kNextKey = {
    "next_key",
    "SELECT nextval(pg_get_serial_sequence('vehicles', 'key')::regclass)"};
constexpr Statement kInsertVehicle = {
    "insert_vehicle",
    "WITH v AS (INSERT INTO vehicles "
    "(key, id, format, revision, checksum, payload) VALUES ($1::int8, "
    "$2::text, $3::int8, $4::int8, $5::int8, $6::bytea) "
    "ON CONFLICT (id) DO NOTHING RETURNING key, revision) "
    "INSERT INTO heads (key, revision) SELECT key, revision FROM v "
    "RETURNING key"};

// The conditions that every write but an append begins with: $1 key, $2 owner,
// $3 epoch, $4 revision.
#define REVISIT_FENCE(MORE_CHANGES, MORE_CONDITIONS) \
  "WITH h AS (UPDATE heads SET revision = "          \
  "greatest(revision, $4::int8)" MORE_CHANGES        \
  " WHERE key = $1::int8 AND owner = $2::uuid AND "  \
  "epoch = $3::int8" MORE_CONDITIONS " RETURNING key) "
// The vehicle's row is as it was when its new version was made: $5 checksum.
#define REVISIT_UNCHANGED                                         \
  " AND EXISTS (SELECT 1 FROM vehicles WHERE key = $1::int8 AND " \
  "checksum = $5::int8)"
// $6 format, $7 revision, $8 checksum, $9 payload.
#define REVISIT_REPLACE_VEHICLE                                          \
  "UPDATE vehicles v SET format = $6::int8, revision = $7::int8, "       \
  "checksum = $8::int8, payload = $9::bytea FROM h WHERE v.key = h.key " \
  "RETURNING v.key"

constexpr Statement kChangeVehicle = {"change_vehicle",
                                      REVISIT_FENCE("", REVISIT_UNCHANGED)
                                          REVISIT_REPLACE_VEHICLE};
// $10 first sequence, $11 count, $12 revision, $13 checksum, $14 payload.
constexpr Statement kAppendWithVehicle = {
    "append_with_vehicle",
    REVISIT_FENCE(", durable_sequence = $10::int8 + $11::int8 - 1",
                  REVISIT_UNCHANGED " AND durable_sequence = $10::int8 - 1")
    ", b AS (INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) SELECT key, $10::int8, $11::int8, $6::int8, "
    "$12::int8, $13::int8, $14::bytea FROM h) " REVISIT_REPLACE_VEHICLE};
// $10 last sequence, $11 and $12 ids of damaged pairs.
constexpr Statement kDropDamaged = {
    "drop_damaged",
    REVISIT_FENCE(", durable_sequence = $10::int8",
                  REVISIT_UNCHANGED
                  " AND coalesce((SELECT first_sequence + "
                  "least(greatest(count, 1), 1000000) - 1 FROM batches "
                  "WHERE vehicle_key = $1::int8 AND first_sequence <= "
                  "$10::int8 ORDER BY first_sequence DESC LIMIT 1), 0) = "
                  "$10::int8")
    ", b AS (DELETE FROM batches t USING h WHERE t.vehicle_key = h.key AND "
    "t.first_sequence > $10::int8), "
    "r AS (DELETE FROM revised_batches t USING h WHERE t.vehicle_key = h.key "
    "AND t.first_sequence > $10::int8), "
    "l AS (DELETE FROM loop_closures t USING h WHERE t.vehicle_key = h.key "
    "AND (greatest(t.query_sequence, t.matched_sequence) > $10::int8 OR "
    "t.id = ANY($11::text[]))), "
    "n AS (DELETE FROM rejected_candidates t USING h WHERE t.vehicle_key = "
    "h.key AND (greatest(t.query_sequence, t.matched_sequence) > $10::int8 OR "
    "t.id = ANY($12::text[]))) " REVISIT_REPLACE_VEHICLE};
constexpr Statement kRaiseRevision = {
    "raise_revision", REVISIT_FENCE("", "") "SELECT key FROM h"};
constexpr Statement kRemoveVehicle = {
    "remove_vehicle",
    "WITH h AS (DELETE FROM heads WHERE key = $1::int8 AND owner = $2::uuid "
    "AND epoch = $3::int8 RETURNING key), "
    "v AS (DELETE FROM vehicles t USING h WHERE t.key = h.key), "
    "l AS (DELETE FROM loop_closures t USING h WHERE t.vehicle_key = h.key), "
    "n AS (DELETE FROM rejected_candidates t USING h "
    "WHERE t.vehicle_key = h.key), "
    "o AS (DELETE FROM handovers t USING h WHERE t.key = h.key) "
    "INSERT INTO deleted_vehicles (key) SELECT key FROM h RETURNING key"};

// Of each run: $1 key, $2 owner, $3 epoch, $4 first and $5 last sequence,
// $6 revision, and $7 and $8 the numbers of its first and last row. Of each
// row: $9 first sequence, $10 count, $11 revision, $12 checksum, and $13 and
// $14 where its payload begins in $15 and how long it is. $16 is the format.
//
// Rows are reached by their number, because a join of them with the updated
// heads takes thrice the time, and payloads lie in one value, because an array
// of them is walked from its start for each. An update takes one row of its
// source for each of its own, hence one run per vehicle.
constexpr Statement kAppend = {
    "append",
    "WITH h AS (UPDATE heads v SET durable_sequence = a.l, "
    "revision = greatest(v.revision, a.rev) FROM unnest($1::int8[], "
    "$2::uuid[], $3::int8[], $4::int8[], $5::int8[], $6::int8[], $7::int8[], "
    "$8::int8[]) AS a(k, o, e, f, l, rev, first_row, last_row) WHERE "
    "v.key = a.k AND v.owner = a.o AND v.epoch = a.e AND "
    "v.durable_sequence = a.f - 1 RETURNING a.k, a.first_row, a.last_row), "
    "b AS (INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) SELECT h.k, ($9::int8[])[i], "
    "($10::int8[])[i], $16::int8, ($11::int8[])[i], ($12::int8[])[i], "
    "substring($15::bytea FROM (($13::int8[])[i])::int4 FOR "
    "(($14::int8[])[i])::int4) FROM h, "
    "generate_series(h.first_row, h.last_row) i) SELECT k FROM h"};

// $1 key, $2 first sequences, $3 counts, $4 checksums, $5 payloads, $6 format,
// $7 revision.
constexpr Statement kRevise = {
    "revise",
    "INSERT INTO revised_batches AS r (vehicle_key, first_sequence, count, "
    "format, revision, checksum, payload) SELECT $1::int8, a.f, a.n, $6::int8, "
    "$7::int8, a.ck, a.p FROM unnest($2::int8[], $3::int8[], $4::int8[], "
    "$5::bytea[]) AS a(f, n, ck, p) JOIN batches b ON b.vehicle_key = "
    "$1::int8 AND b.first_sequence = a.f AND b.count = a.n "
    "ON CONFLICT (vehicle_key, first_sequence) DO UPDATE SET "
    "count = excluded.count, format = excluded.format, "
    "revision = excluded.revision, checksum = excluded.checksum, "
    "payload = excluded.payload RETURNING r.first_sequence"};

// A row of `deleted_vehicles` goes in the statement after the one that removed
// its last batches, since a statement does not see what it does itself.
constexpr Statement kPurge = {
    "purge",
    "WITH d AS (SELECT key FROM deleted_vehicles ORDER BY key LIMIT 1 "
    "FOR UPDATE SKIP LOCKED), "
    "b AS (DELETE FROM batches WHERE (vehicle_key, first_sequence) IN "
    "(SELECT t.vehicle_key, t.first_sequence FROM d JOIN batches t "
    "ON t.vehicle_key = d.key ORDER BY t.first_sequence LIMIT 256)), "
    "r AS (DELETE FROM revised_batches WHERE (vehicle_key, first_sequence) IN "
    "(SELECT t.vehicle_key, t.first_sequence FROM d JOIN revised_batches t "
    "ON t.vehicle_key = d.key ORDER BY t.first_sequence LIMIT 256)), "
    "e AS (DELETE FROM deleted_vehicles x USING d WHERE x.key = d.key AND "
    "NOT EXISTS (SELECT 1 FROM batches WHERE vehicle_key = d.key) AND "
    "NOT EXISTS (SELECT 1 FROM revised_batches WHERE vehicle_key = d.key)) "
    "SELECT key FROM d"};

struct PairStatements {
  Statement list;
  Statement insert;
  Statement remove;
};

#define REVISIT_PAIR_STATEMENTS(TABLE)                                         \
  {                                                                            \
    {"list_" TABLE,                                                            \
     "SELECT id, format, query_sequence, matched_sequence, create_time_ns, "   \
     "checksum, payload FROM " TABLE                                           \
     " WHERE vehicle_key = $1::int8 AND id > $2::text ORDER BY id "            \
     "LIMIT $3::int8"},                                                        \
        {"insert_" TABLE,                                                      \
         REVISIT_FENCE("",                                                     \
                       " AND NOT EXISTS (SELECT 1 FROM " TABLE                 \
                       " WHERE vehicle_key = $1::int8 AND "                    \
                       "id = $5::text)") "INSERT INTO " TABLE                  \
                                         " (vehicle_key, id, format, "         \
                                         "query_sequence, matched_sequence, "  \
                                         "create_time_ns, checksum, payload) " \
                                         "SELECT key, $5::text, $6::int8, "    \
                                         "$7::int8, $8::int8, $9::int8, "      \
                                         "$10::int8, $11::bytea FROM h "       \
                                         "RETURNING vehicle_key"},             \
    {                                                                          \
      "remove_" TABLE,                                                         \
          REVISIT_FENCE("",                                                    \
                        " AND EXISTS (SELECT 1 FROM " TABLE                    \
                        " WHERE vehicle_key = $1::int8 AND "                   \
                        "id = $5::text)") "DELETE FROM " TABLE                 \
                                          " t USING h WHERE t.vehicle_key = "  \
                                          "h.key AND t.id = $5::text "         \
                                          "RETURNING t.vehicle_key"            \
    }                                                                          \
  }
constexpr PairStatements kClosures = REVISIT_PAIR_STATEMENTS("loop_closures");
constexpr PairStatements kRejections =
    REVISIT_PAIR_STATEMENTS("rejected_candidates");
#undef REVISIT_PAIR_STATEMENTS
#undef REVISIT_REPLACE_VEHICLE
#undef REVISIT_UNCHANGED
#undef REVISIT_FENCE

const PairStatements& StatementsOf(PairKind kind) {
  return kind == PairKind::kLoopClosure ? kClosures : kRejections;
}

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

// A row of kFindVehicle.
VehicleRecord VehicleAt(const PostgresRows& rows, int row) {
  VehicleRecord record;
  record.key = rows.Integer(row, 0);
  record.id = rows.Bytes(row, 1);
  record.revision = Unsigned(rows.Integer(row, 3));
  record.payload = rows.Bytes(row, 5);
  CheckVehicleRow(rows.Integer(row, 2), rows.Integer(row, 4), &record);
  record.loop_closure_count = rows.Integer(row, 8);
  record.rejected_candidate_count = rows.Integer(row, 9);
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

struct Head {
  Uuid owner;
  std::int64_t epoch;
  std::uint64_t durable_sequence;
};

absl::StatusOr<std::map<VehicleKey, Head>> ReadHeads(
    PostgresConnection& connection, const std::vector<std::int64_t>& keys) {
  const auto rows = connection.Run(kHeadRows, Parameters().Add(keys));
  if (!rows.ok()) return rows.status();
  std::map<VehicleKey, Head> heads;
  for (int i = 0; i < rows->size(); ++i) {
    heads[rows->Integer(i, 0)] = {rows->GetUuid(i, 1), rows->Integer(i, 2),
                                  Unsigned(rows->Integer(i, 3))};
  }
  return heads;
}

// Under a claim that has ended nothing is written. No vehicle has its owner and
// epoch.
const Claim& Compared(const Claim* claim) {
  static const Claim& none = *new Claim;
  return claim == nullptr || claim->has_ended ? none : *claim;
}

bool Holds(const Claim* claim, const Head& head) {
  // Behind what was stored: the database is one that lacks the last commits.
  return claim != nullptr && !claim->has_ended && claim->owner == head.owner &&
         claim->epoch == head.epoch &&
         head.durable_sequence >= claim->durable_sequence;
}

// Why a vehicle's append wrote nothing.
absl::Status WhyNotAppended(const std::map<VehicleKey, Head>& heads,
                            VehicleKey key, const Claim* claim,
                            std::uint64_t first_sequence) {
  const auto head = heads.find(key);
  if (head == heads.end()) return UnknownVehicle(key);
  if (!Holds(claim, head->second) ||
      head->second.durable_sequence + 1 == first_sequence) {
    return Fenced(claim == nullptr ? "the vehicle of key " + std::to_string(key)
                                   : "vehicle '" + claim->vehicle_id + "'");
  }
  return SequenceGap(claim->vehicle_id, head->second.durable_sequence + 1,
                     first_sequence);
}

// Why a write of something else wrote nothing: `otherwise`, if the claim holds.
absl::Status WhyNotWritten(PostgresConnection& connection, const Fence& fence,
                           absl::Status otherwise) {
  const auto heads = ReadHeads(connection, {fence.key});
  if (!heads.ok()) return heads.status();
  const auto head = heads->find(fence.key);
  if (head == heads->end()) return UnknownVehicle(fence.key);
  if (!Holds(fence.claim.get(), head->second)) {
    return Fenced("the vehicle of key " + std::to_string(fence.key));
  }
  return otherwise;
}

Parameters FenceOf(const Fence& fence) {
  Parameters parameters;
  const Claim& claim = Compared(fence.claim.get());
  parameters.Add(fence.key).Add(claim.owner).Add(claim.epoch);
  return parameters;
}

Parameters FenceOf(const Fence& fence, std::uint64_t revision) {
  return FenceOf(fence).Add(Signed(revision));
}

// The vehicle's row, and the checksum by which it is known again.
struct VehicleRow {
  VehicleRecord record;
  std::int64_t checksum = 0;
};

absl::StatusOr<VehicleRow> ReadVehicleRow(PostgresConnection& connection,
                                          VehicleKey key) {
  const auto rows = connection.Run(kVehicleRow, Parameters().Add(key));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle(key);
  VehicleRow row;
  row.record.key = key;
  row.record.id = rows->Bytes(0, 0);
  row.record.revision = Unsigned(rows->Integer(0, 2));
  row.checksum = rows->Integer(0, 3);
  row.record.payload = rows->Bytes(0, 4);
  CheckVehicleRow(rows->Integer(0, 1), row.checksum, &row.record);
  // A damaged row that is written again would pass for sound.
  if (!row.record.damage.ok()) return row.record.damage;
  return row;
}

// Parameters of a statement that replaces the vehicle's row.
Parameters Replacing(const Fence& fence, VehicleRow row,
                     const std::string& payload, std::uint64_t revision) {
  Parameters parameters = FenceOf(fence, revision);
  row.record.payload = payload;
  row.record.revision = std::max(row.record.revision, revision);
  parameters.Add(row.checksum)
      .Add(kSharedRowFormat)
      .Add(Signed(row.record.revision))
      .Add(ChecksumOfVehicle(kSharedRowFormat, row.record))
      .AddText(row.record.payload);
  return parameters;
}

std::uint64_t LastSequence(const AppendRun& run) {
  const BatchRecord& last = run.back()->batch;
  return last.first_sequence + last.count - 1;
}

void NoteDurable(const Fence& fence, std::uint64_t sequence) {
  if (fence.claim != nullptr) fence.claim->durable_sequence = sequence;
}

absl::Status ReviseSome(PostgresConnection& connection, VehicleKey key,
                        const std::vector<BatchRecord>& batches,
                        std::uint64_t revision) {
  std::vector<std::int64_t> firsts;
  std::vector<std::int64_t> counts;
  std::vector<std::int64_t> checksums;
  std::vector<const std::string*> payloads;
  for (const BatchRecord& batch : batches) {
    firsts.push_back(Signed(batch.first_sequence));
    counts.push_back(batch.count);
    checksums.push_back(
        ChecksumOfBatch(kSharedRowFormat, key, BatchVersion::kCurrent, batch));
    payloads.push_back(&batch.payload);
  }
  const auto rows = connection.Run(kRevise, Parameters()
                                                .Add(key)
                                                .Add(firsts)
                                                .Add(counts)
                                                .Add(checksums)
                                                .AddBytes(payloads)
                                                .Add(kSharedRowFormat)
                                                .Add(Signed(revision)));
  if (!rows.ok()) return rows.status();
  std::set<std::int64_t> revised;
  for (int i = 0; i < rows->size(); ++i) revised.insert(rows->Integer(i, 0));
  for (const BatchRecord& batch : batches) {
    if (revised.count(Signed(batch.first_sequence)) == 0) {
      return NoSuchBatch(batch);
    }
  }
  return absl::OkStatus();
}

// Passes batches on in groups in which no first sequence occurs twice.
absl::Status ReviseInGroups(PostgresConnection& connection, VehicleKey key,
                            const BatchSource& source, std::uint64_t revision) {
  std::vector<BatchRecord> group;
  std::set<std::uint64_t> firsts;
  std::size_t bytes = 0;
  const auto flush = [&] {
    const absl::Status status = ReviseSome(connection, key, group, revision);
    group.clear();
    firsts.clear();
    bytes = 0;
    return status;
  };
  absl::Status status = source([&](const BatchRecord& batch) {
    if (firsts.count(batch.first_sequence) > 0 ||
        group.size() >= static_cast<std::size_t>(kBatchesAtOnce) ||
        bytes >= kRevisedBytesAtOnce) {
      if (absl::Status flushed = flush(); !flushed.ok()) return flushed;
    }
    group.push_back(batch);
    group.back().revision = revision;
    firsts.insert(batch.first_sequence);
    bytes += batch.payload.size();
    return absl::OkStatus();
  });
  if (status.ok() && !group.empty()) status = flush();
  return status;
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

absl::StatusOr<VehicleRecord> FindVehicle(PostgresConnection& connection,
                                          const std::string& id) {
  const auto rows = connection.Run(kFindVehicle, Parameters().AddText(id));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle("'" + id + "'");
  return VehicleAt(*rows, 0);
}

absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit) {
  // Ids are ASCII.
  const auto rows =
      connection.Run(kFindVehicles, Parameters()
                                        .AddText(after_id)
                                        .AddText(prefix)
                                        .AddText(prefix + "\x7f")
                                        .Add(std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  std::vector<VehicleRecord> records;
  for (int i = 0; i < rows->size(); ++i) {
    records.push_back(VehicleAt(*rows, i));
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
  const auto vehicle = connection.Run(kVehicleRow, Parameters().Add(key));
  if (!vehicle.ok()) return vehicle.status();
  if (vehicle->size() == 0) return UnknownVehicle(key);
  const auto rows = connection.Run(StatementsOf(kind).list,
                                   Parameters().Add(key).AddText(after_id).Add(
                                       std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  const std::string vehicle_id = Printable(vehicle->Bytes(0, 0));
  std::vector<PosePairRecord> pairs;
  for (int i = 0; i < rows->size(); ++i) {
    PosePairRecord pair;
    pair.id = rows->Bytes(i, 0);
    pair.query_sequence = Unsigned(rows->Integer(i, 2));
    pair.matched_sequence = Unsigned(rows->Integer(i, 3));
    pair.create_time_ns = rows->Integer(i, 4);
    pair.payload = rows->Bytes(i, 6);
    CheckPosePairRow(rows->Integer(i, 1), rows->Integer(i, 5), key, kind,
                     vehicle_id, &pair);
    pairs.push_back(std::move(pair));
  }
  return pairs;
}

absl::StatusOr<VehicleKey> InsertVehicle(PostgresConnection& connection,
                                         VehicleRecord record) {
  // The checksum covers the key.
  const auto key = connection.Run(kNextKey);
  if (!key.ok()) return key.status();
  record.key = key->Integer(0, 0);
  const auto rows = connection.Run(
      kInsertVehicle, Parameters()
                          .Add(record.key)
                          .AddText(record.id)
                          .Add(kSharedRowFormat)
                          .Add(Signed(record.revision))
                          .Add(ChecksumOfVehicle(kSharedRowFormat, record))
                          .AddText(record.payload));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return VehicleExists(record.id);
  return record.key;
}

absl::Status ChangeVehicle(PostgresConnection& connection, const Fence& fence,
                           const std::string& payload, std::uint64_t revision) {
  auto row = ReadVehicleRow(connection, fence.key);
  if (!row.ok()) return row.status();
  const auto rows = connection.Run(
      kChangeVehicle, Replacing(fence, *std::move(row), payload, revision));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status RemoveVehicle(PostgresConnection& connection, const Fence& fence) {
  const auto rows = connection.Run(kRemoveVehicle, FenceOf(fence));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status AppendRuns(PostgresConnection& connection,
                        const std::vector<AppendRun>& runs,
                        std::vector<absl::Status>* results) {
  std::vector<std::int64_t> keys;
  std::vector<Uuid> owners;
  std::vector<std::int64_t> epochs;
  std::vector<std::int64_t> run_firsts;
  std::vector<std::int64_t> run_lasts;
  std::vector<std::int64_t> run_revisions;
  std::vector<std::int64_t> first_rows;
  std::vector<std::int64_t> last_rows;
  std::vector<std::int64_t> firsts;
  std::vector<std::int64_t> counts;
  std::vector<std::int64_t> revisions;
  std::vector<std::int64_t> checksums;
  std::vector<std::int64_t> starts;
  std::vector<std::int64_t> lengths;
  std::string payloads;
  for (const AppendRun& run : runs) {
    const Claim& claim = Compared(run.front()->claim.get());
    keys.push_back(run.front()->key);
    owners.push_back(claim.owner);
    epochs.push_back(claim.epoch);
    run_firsts.push_back(Signed(run.front()->batch.first_sequence));
    run_lasts.push_back(Signed(LastSequence(run)));
    // SQL counts from 1.
    first_rows.push_back(static_cast<std::int64_t>(firsts.size()) + 1);
    std::uint64_t highest = 0;
    for (const PendingWrite* row : run) {
      const BatchRecord& batch = row->batch;
      highest = std::max(highest, batch.revision);
      firsts.push_back(Signed(batch.first_sequence));
      counts.push_back(batch.count);
      revisions.push_back(Signed(batch.revision));
      checksums.push_back(ChecksumOfBatch(kSharedRowFormat, row->key,
                                          BatchVersion::kAsSent, batch));
      starts.push_back(static_cast<std::int64_t>(payloads.size()) + 1);
      lengths.push_back(static_cast<std::int64_t>(batch.payload.size()));
      payloads += batch.payload;
    }
    run_revisions.push_back(Signed(highest));
    last_rows.push_back(static_cast<std::int64_t>(firsts.size()));
  }
  const auto answer = connection.Run(kAppend, Parameters()
                                                  .Add(keys)
                                                  .Add(owners)
                                                  .Add(epochs)
                                                  .Add(run_firsts)
                                                  .Add(run_lasts)
                                                  .Add(run_revisions)
                                                  .Add(first_rows)
                                                  .Add(last_rows)
                                                  .Add(firsts)
                                                  .Add(counts)
                                                  .Add(revisions)
                                                  .Add(checksums)
                                                  .Add(starts)
                                                  .Add(lengths)
                                                  .AddText(payloads)
                                                  .Add(kSharedRowFormat));
  if (!answer.ok()) return answer.status();
  std::set<VehicleKey> written;
  for (int i = 0; i < answer->size(); ++i) {
    written.insert(answer->Integer(i, 0));
  }
  std::vector<std::int64_t> missing;
  for (const AppendRun& run : runs) {
    const VehicleKey key = run.front()->key;
    if (written.count(key) == 0) {
      missing.push_back(key);
    } else {
      NoteDurable({key, run.front()->claim}, LastSequence(run));
    }
  }
  results->assign(runs.size(), absl::OkStatus());
  if (missing.empty()) return absl::OkStatus();
  const auto heads = ReadHeads(connection, missing);
  for (std::size_t i = 0; i < runs.size(); ++i) {
    const PendingWrite& first = *runs[i].front();
    if (written.count(first.key) > 0) continue;
    (*results)[i] = heads.ok()
                        ? WhyNotAppended(*heads, first.key, first.claim.get(),
                                         first.batch.first_sequence)
                        : heads.status();
  }
  return absl::OkStatus();
}

absl::Status AppendWithVehicle(PostgresConnection& connection,
                               const Fence& fence, const BatchRecord& batch,
                               const std::string& vehicle_payload) {
  auto row = ReadVehicleRow(connection, fence.key);
  if (!row.ok()) return row.status();
  Parameters parameters =
      Replacing(fence, *std::move(row), vehicle_payload, batch.revision);
  parameters.Add(Signed(batch.first_sequence))
      .Add(std::int64_t{batch.count})
      .Add(Signed(batch.revision))
      .Add(ChecksumOfBatch(kSharedRowFormat, fence.key, BatchVersion::kAsSent,
                           batch))
      .AddText(batch.payload);
  const auto rows = connection.Run(kAppendWithVehicle, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteDurable(fence, batch.first_sequence + batch.count - 1);
    return absl::OkStatus();
  }
  const auto heads = ReadHeads(connection, {fence.key});
  if (!heads.ok()) return heads.status();
  return WhyNotAppended(*heads, fence.key, fence.claim.get(),
                        batch.first_sequence);
}

absl::Status ReviseBatchRows(PostgresConnection& connection, const Fence& fence,
                             const BatchSource& batches,
                             std::uint64_t revision) {
  absl::Status status = connection.RunText("BEGIN").status();
  if (!status.ok()) return status;
  // The fence comes first: from here on nobody can claim the vehicle.
  const auto head = connection.Run(kRaiseRevision, FenceOf(fence, revision));
  status = head.status();
  const bool holds = head.ok() && head->size() > 0;
  if (holds) {
    status = ReviseInGroups(connection, fence.key, batches, revision);
  }
  if (holds && status.ok()) {
    const auto committed = connection.RunText("COMMIT");
    if (!committed.ok()) return committed.status();
    if (committed->Tag() == "COMMIT") return absl::OkStatus();
    return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "the database rolled the revision back");
  }
  // A connection that cannot roll back is not used again.
  const bool in_doubt = connection.IsInDoubt();
  if (!in_doubt) connection.RunText("ROLLBACK").IgnoreError();
  if (!status.ok()) return status;
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status DropDamagedRows(PostgresConnection& connection, const Fence& fence,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision) {
  auto row = ReadVehicleRow(connection, fence.key);
  if (!row.ok()) return row.status();
  Parameters parameters = Replacing(fence, *std::move(row), payload, revision);
  parameters.Add(Signed(last_sequence));
  for (const PairKind kind : kPairKinds) {
    // Reads all pairs, without a limit.
    const auto pairs = FindPosePairs(connection, fence.key, kind, "",
                                     std::numeric_limits<int>::max());
    if (!pairs.ok()) return pairs.status();
    std::vector<const std::string*> damaged;
    for (const PosePairRecord& pair : *pairs) {
      if (!pair.damage.ok()) damaged.push_back(&pair.id);
    }
    parameters.AddTexts(damaged);
  }
  const auto rows = connection.Run(kDropDamaged, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteDurable(fence, last_sequence);
    return absl::OkStatus();
  }
  return WhyNotWritten(connection, fence, NoBatchEndsAt(last_sequence));
}

absl::Status InsertPosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision) {
  Parameters parameters = FenceOf(fence, revision);
  parameters.AddText(pair.id)
      .Add(kSharedRowFormat)
      .Add(Signed(pair.query_sequence))
      .Add(Signed(pair.matched_sequence))
      .Add(pair.create_time_ns)
      .Add(ChecksumOfPosePair(kSharedRowFormat, fence.key, kind, pair))
      .AddText(pair.payload);
  const auto rows = connection.Run(StatementsOf(kind).insert, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, PairExists(kind, pair.id));
}

absl::Status RemovePosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision) {
  const auto rows = connection.Run(StatementsOf(kind).remove,
                                   FenceOf(fence, revision).AddText(id));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, NoSuchPair(kind, id));
}

absl::StatusOr<bool> PurgeSome(PostgresConnection& connection) {
  const auto rows = connection.Run(kPurge);
  if (!rows.ok()) return rows.status();
  return rows->size() > 0;
}

const char* AppendSql() { return kAppend.sql; }

}  // namespace revisit::server
