#include "server/storage/postgres/postgres_changes.h"

#include <algorithm>
#include <cstddef>
#include <functional>
#include <limits>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/postgres/postgres_checks.h"
#include "server/storage/postgres/postgres_reads.h"
#include "server/storage/postgres/postgres_snapshots.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Batches that one statement revises, and their bytes, which the last of them
// may exceed.
constexpr std::size_t kRevisedAtOnce = 64;
constexpr std::size_t kRevisedBytesAtOnce = std::size_t{4} << 20;

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

constexpr Statement kChangeVehicle = {"change_vehicle",
                                      REVISIT_FENCE("", REVISIT_UNCHANGED)
                                          REVISIT_REPLACE_VEHICLE};

// $11 last sequence, $12 and $13 ids of damaged pairs, $14 numbers of damaged
// deletions, $15 damaged checks, $16 and $17 the checked sequence and the last
// event that the rows tell of: where a head that was lost came back without
// them, it gets these.
constexpr Statement kDropDamaged = {
    "drop_damaged",
    REVISIT_FENCE(
        ", durable_sequence = $11::int8, "
        "checks_stored = checks_stored OR last_event < $17::int8, "
        "checked_sequence = least($11::int8, CASE WHEN last_event < $17::int8 "
        "THEN $16::int8 ELSE checked_sequence END), "
        "last_event = greatest(last_event, $17::int8)",
        REVISIT_UNCHANGED
        " AND coalesce((SELECT first_sequence + "
        "least(greatest(count, 1), 1000000) - 1 FROM batches "
        "WHERE vehicle_key = $1::int8 AND first_sequence <= $11::int8 "
        "ORDER BY first_sequence DESC LIMIT 1), 0) = $11::int8")
        REVISIT_FORGET_SNAPSHOT
    ", b AS (DELETE FROM batches t USING h WHERE t.vehicle_key = h.key AND "
    "t.first_sequence > $11::int8), "
    "r AS (DELETE FROM revised_batches t USING h WHERE t.vehicle_key = h.key "
    "AND t.first_sequence > $11::int8), "
    "l AS (DELETE FROM loop_closures t USING h WHERE t.vehicle_key = h.key "
    "AND (greatest(t.query_sequence, t.matched_sequence) > $11::int8 OR "
    "t.id = ANY($12::text[]))), "
    "n AS (DELETE FROM rejected_candidates t USING h WHERE t.vehicle_key = "
    "h.key AND (greatest(t.query_sequence, t.matched_sequence) > $11::int8 "
    "OR t.id = ANY($13::text[]))), "
    "x AS (DELETE FROM deleted_pose_pairs t USING h WHERE t.vehicle_key = "
    "h.key AND t.number = ANY($14::int8[])), "
    "c AS (DELETE FROM checks t USING h WHERE t.vehicle_key = h.key AND "
    "(t.sequence > $11::int8 OR t.sequence = "
    "ANY($15::int8[]))) " REVISIT_REPLACE_VEHICLE};
constexpr Statement kRaiseRevision = {
    "raise_revision", REVISIT_FENCE("", "") "SELECT key FROM h"};
constexpr Statement kHeadHolds = {
    "head_holds", "SELECT key FROM heads WHERE " REVISIT_HEAD_HOLDS};
#define REVISIT_REMOVE_VEHICLE(MORE)                                         \
  "WITH h AS (DELETE FROM heads WHERE " REVISIT_HEAD_HOLDS                   \
  " RETURNING key) " REVISIT_FORGET_SNAPSHOT                                 \
  ", v AS (DELETE FROM vehicles t USING h WHERE t.key = h.key), "            \
  "l AS (DELETE FROM loop_closures t USING h WHERE t.vehicle_key = h.key), " \
  "n AS (DELETE FROM rejected_candidates t USING h "                         \
  "WHERE t.vehicle_key = h.key), "                                           \
  "o AS (DELETE FROM handovers t USING h WHERE t.key = h.key) " MORE         \
  "INSERT INTO deleted_vehicles (key) SELECT key FROM h RETURNING key"
// Deleted pairs, checks, the payloads of events, and what groups have of the
// vehicle go with the row in vehicles.
constexpr Statement kRemoveVehicle = {"remove_vehicle",
                                      REVISIT_REMOVE_VEHICLE("")};
// $5 number, $6 format, $7 time, $8 checksum, $9 payload.
constexpr Statement kRemoveVehicleAndTell = {
    "remove_vehicle_and_tell",
    REVISIT_REMOVE_VEHICLE(
        ", w AS (INSERT INTO events (vehicle_key, number, format, time_ns, "
        "checksum, payload) SELECT key, $5::int8, $6::int8, $7::int8, "
        "$8::int8, $9::bytea FROM h) ")};
#undef REVISIT_REMOVE_VEHICLE

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

// $1 key, $2 first sequence, $3 the one behind the last.
constexpr Statement kHeldRange = {
    "held_range",
    "SELECT coalesce(min(first_sequence), 0)::int8, "
    "coalesce(max(first_sequence + count), 0)::int8, "
    "coalesce(sum(count), 0)::int8 FROM batches WHERE vehicle_key = $1::int8 "
    "AND first_sequence >= $2::int8 AND first_sequence < $3::int8"};
constexpr Statement kRemoveBatches = {
    "remove_batches",
    "DELETE FROM batches WHERE vehicle_key = $1::int8 AND "
    "first_sequence >= $2::int8 AND first_sequence < $3::int8"};
constexpr Statement kRemoveRevisions = {
    "remove_revisions",
    "DELETE FROM revised_batches WHERE vehicle_key = $1::int8 AND "
    "first_sequence >= $2::int8 AND first_sequence < $3::int8"};
// $1 key, $2 first sequence, $3 count, $4 format, $5 revision, $6 checksum, $7
// payload.
constexpr Statement kPutBatch = {
    "put_batch",
    "INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) VALUES ($1::int8, $2::int8, $3::int8, "
    "$4::int8, $5::int8, $6::int8, $7::bytea)"};
constexpr Statement kPutRevision = {
    "put_revision",
    "INSERT INTO revised_batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) VALUES ($1::int8, $2::int8, $3::int8, "
    "$4::int8, $5::int8, $6::int8, $7::bytea)"};

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
  Statement insert;
  Statement insert_with_checks;
  Statement remove;
  Statement remove_with_checks;
  // $1 vehicle, $2 id.
  Statement find;
};

// $6 id, $7 format, $8 query sequence, $9 matched sequence, $10 creation, $11
// checksum, $12 payload.
#define REVISIT_INSERT_PAIR(TABLE, CHANGES, CONDITIONS, MORE)                  \
  REVISIT_FENCE(CHANGES,                                                       \
                CONDITIONS " AND NOT EXISTS (SELECT 1 FROM " TABLE             \
                           " WHERE vehicle_key = $1::int8 AND id = $6::text)") \
  MORE "INSERT INTO " TABLE                                                    \
       " (vehicle_key, id, format, query_sequence, matched_sequence, "         \
       "create_time_ns, checksum, payload) SELECT key, $6::text, "             \
       "$7::int8, $8::int8, $9::int8, $10::int8, $11::int8, "                  \
       "$12::bytea FROM h RETURNING vehicle_key"
// Keeps what is deleted, and removes the rows behind the last ones, which are
// one more once this is done. $6 id, $7 number, $8 kind, $9 format, $10 query
// sequence, $11 matched sequence, $12 creation, $13 deletion, $14 checksum, $15
// payload, $16 how many of those before stay.
#define REVISIT_REMOVE_PAIR(TABLE, CHANGES, CONDITIONS, MORE)                  \
  REVISIT_FENCE(CHANGES,                                                       \
                CONDITIONS " AND EXISTS (SELECT 1 FROM " TABLE                 \
                           " WHERE vehicle_key = $1::int8 AND id = $6::text)") \
  ", k AS (INSERT INTO deleted_pose_pairs (vehicle_key, number, kind, "        \
  "id, format, query_sequence, matched_sequence, create_time_ns, "             \
  "delete_time_ns, checksum, payload) SELECT key, $7::int8, $8::int8, "        \
  "$6::text, $9::int8, $10::int8, $11::int8, $12::int8, $13::int8, "           \
  "$14::int8, $15::bytea FROM h), "                                            \
  "o AS (DELETE FROM deleted_pose_pairs t USING h WHERE t.vehicle_key = "      \
  "h.key AND t.number <= (SELECT number FROM deleted_pose_pairs WHERE "        \
  "vehicle_key = $1::int8 ORDER BY number DESC LIMIT 1 OFFSET "                \
  "$16::int8)) " MORE "DELETE FROM " TABLE                                     \
  " t USING h WHERE t.vehicle_key = h.key AND t.id = $6::text RETURNING"       \
  " t.vehicle_key"
#define REVISIT_PAIR_STATEMENTS(TABLE)                                        \
  {                                                                           \
    {"insert_" TABLE, REVISIT_INSERT_PAIR(TABLE, "", "", "")},                \
        {"insert_with_checks_" TABLE,                                         \
         REVISIT_INSERT_PAIR(                                                 \
             TABLE, REVISIT_CHECKS_CHANGES("$13"),                            \
             REVISIT_CHECKS_CONDITIONS("$13"),                                \
             REVISIT_CHECKS_ROWS("$13", "$14", "$15", "$16", "$17", "$18"))}, \
        {"remove_" TABLE, REVISIT_REMOVE_PAIR(TABLE, "", "", "")},            \
        {"remove_with_checks_" TABLE,                                         \
         REVISIT_REMOVE_PAIR(                                                 \
             TABLE, REVISIT_CHECKS_CHANGES("$17"),                            \
             REVISIT_CHECKS_CONDITIONS("$17"),                                \
             REVISIT_CHECKS_ROWS("$17", "$18", "$19", "$20", "$21", "$22"))}, \
    {                                                                         \
      "find_" TABLE, "SELECT vehicle_key FROM " TABLE                         \
                     " WHERE vehicle_key = $1::int8 AND id = $2::text"        \
    }                                                                         \
  }
constexpr PairStatements kClosures = REVISIT_PAIR_STATEMENTS("loop_closures");
constexpr PairStatements kRejections =
    REVISIT_PAIR_STATEMENTS("rejected_candidates");
#undef REVISIT_PAIR_STATEMENTS
#undef REVISIT_INSERT_PAIR
#undef REVISIT_REMOVE_PAIR

constexpr Statement kLastNumber = {
    "last_number",
    "SELECT coalesce(max(number), 0)::int8 FROM deleted_pose_pairs WHERE "
    "vehicle_key = $1::int8"};

const PairStatements& StatementsOf(PairKind kind) {
  return kind == PairKind::kLoopClosure ? kClosures : kRejections;
}

// Why a pair was not written: `otherwise` if it is there as `was_there` says,
// else because of the checks that go with it.
absl::Status WhyPairNotWritten(PostgresConnection& connection,
                               const Fence& fence, PairKind kind,
                               const std::string& id,
                               const std::optional<ChecksWrite>& checks,
                               bool was_there, absl::Status otherwise) {
  if (checks) {
    const auto pair = connection.Run(StatementsOf(kind).find,
                                     Parameters().Add(fence.key).AddText(id));
    if (!pair.ok()) return pair.status();
    if ((pair->size() > 0) != was_there) {
      const absl::StatusOr<ChecksHead> head = FindChecksHead(connection, fence);
      if (!head.ok()) return head.status();
      otherwise = OtherChecksHead(*head, checks->before);
    }
  }
  return WhyNotWritten(connection, fence, std::move(otherwise));
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
    absl::Status status = ForgetSnapshot(connection, key);
    if (status.ok()) status = ReviseSome(connection, key, group, revision);
    group.clear();
    firsts.clear();
    bytes = 0;
    return status;
  };
  absl::Status status = source([&](const BatchRecord& batch) {
    if (firsts.count(batch.first_sequence) > 0 ||
        group.size() >= kRevisedAtOnce || bytes >= kRevisedBytesAtOnce) {
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

absl::Status PutRow(PostgresConnection& connection, const Statement& put,
                    VehicleKey key, BatchVersion version,
                    const BatchRecord& batch) {
  return connection
      .Run(put, Parameters()
                    .Add(key)
                    .Add(Signed(batch.first_sequence))
                    .Add(std::int64_t{batch.count})
                    .Add(kSharedRowFormat)
                    .Add(Signed(batch.revision))
                    .Add(ChecksumOfBatch(kSharedRowFormat, key, version, batch))
                    .AddText(batch.payload))
      .status();
}

absl::Status Replace(PostgresConnection& connection, VehicleKey key,
                     const std::vector<BatchVersions>& batches) {
  const std::uint64_t first = batches.front().as_sent.first_sequence;
  const BatchRecord& last = batches.back().as_sent;
  const std::uint64_t end = last.first_sequence + last.count;
  const auto range = [&] {
    return Parameters().Add(key).Add(Signed(first)).Add(Signed(end));
  };
  // Rows do not overlap, so these hold the range if they hold as many poses.
  const auto held = connection.Run(kHeldRange, range());
  if (!held.ok()) return held.status();
  if (held->Integer(0, 0) != Signed(first) ||
      held->Integer(0, 1) != Signed(end) ||
      held->Integer(0, 2) != Signed(end - first)) {
    return NoSuchBatches(first, end - 1);
  }
  const absl::Status forgotten = ForgetSnapshot(connection, key);
  if (!forgotten.ok()) return forgotten;
  for (const Statement& remove : {kRemoveBatches, kRemoveRevisions}) {
    const auto removed = connection.Run(remove, range());
    if (!removed.ok()) return removed.status();
  }
  for (const BatchVersions& batch : batches) {
    absl::Status status = PutRow(connection, kPutBatch, key,
                                 BatchVersion::kAsSent, batch.as_sent);
    if (status.ok() && batch.revised) {
      status = PutRow(connection, kPutRevision, key, BatchVersion::kCurrent,
                      *batch.revised);
    }
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

// Does a change of several statements in one step.
absl::Status ChangeBatches(PostgresConnection& connection, const Fence& fence,
                           std::uint64_t revision,
                           const std::function<absl::Status()>& change) {
  bool holds = true;
  const absl::Status status = InTransaction(connection, [&] {
    // The fence comes first: from here on nobody can claim the vehicle.
    const auto head = connection.Run(kRaiseRevision, FenceOf(fence, revision));
    if (!head.ok()) return head.status();
    holds = head->size() > 0;
    return holds ? change() : Fenced("the vehicle");
  });
  if (status.ok()) NoteWritten(fence, revision);
  return holds ? status : WhyNotWritten(connection, fence, status);
}

}  // namespace

absl::StatusOr<VehicleKey> InsertVehicle(PostgresConnection& connection,
                                         VehicleRecord record,
                                         VehicleKey above) {
  // The checksum covers the key.
  do {
    const auto key = connection.Run(kNextKey);
    if (!key.ok()) return key.status();
    record.key = key->Integer(0, 0);
  } while (record.key <= above);
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
  auto row = ReadVehicleRow(connection, fence);
  if (!row.ok()) return row.status();
  const auto rows = connection.Run(
      kChangeVehicle, Replacing(fence, *std::move(row), payload, revision));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteWritten(fence, revision);
    return absl::OkStatus();
  }
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status RemoveVehicle(PostgresConnection& connection, const Fence& fence,
                           EventRecord farewell) {
  // The rows tell more than a head that was lost and came back.
  const absl::StatusOr<ChecksHead> told = HeadOfRows(connection, fence.key);
  if (!told.ok()) return told.status();
  const absl::StatusOr<ChecksHead> head = FindChecksHead(connection, fence);
  if (!head.ok()) return head.status();
  const std::uint64_t last_event = std::max(told->last_event, head->last_event);
  Parameters parameters = FenceOf(fence);
  if (last_event > 0) {
    farewell.number = last_event + 1;
    parameters.Add(Signed(farewell.number))
        .Add(kSharedRowFormat)
        .Add(farewell.time_ns)
        .Add(ChecksumOfEvent(kSharedRowFormat, fence.key, farewell))
        .AddText(farewell.payload);
  }
  const auto rows = connection.Run(
      last_event > 0 ? kRemoveVehicleAndTell : kRemoveVehicle, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::Status ReviseBatchRows(PostgresConnection& connection, const Fence& fence,
                             const BatchSource& batches,
                             std::uint64_t revision) {
  return ChangeBatches(connection, fence, revision, [&] {
    return ReviseInGroups(connection, fence.key, batches, revision);
  });
}

absl::Status ReplaceBatchRows(PostgresConnection& connection,
                              const Fence& fence,
                              const std::vector<BatchVersions>& batches,
                              std::uint64_t revision) {
  return ChangeBatches(connection, fence, revision,
                       [&] { return Replace(connection, fence.key, batches); });
}

absl::Status DropDamagedRows(PostgresConnection& connection, const Fence& fence,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision) {
  auto row = ReadVehicleRow(connection, fence);
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
  const auto deletions = FindDeletedPairs(connection, fence.key);
  if (!deletions.ok()) return deletions.status();
  std::vector<std::int64_t> damaged;
  for (const DeletedPairRecord& deleted : *deletions) {
    if (!deleted.pair.damage.ok()) damaged.push_back(Signed(deleted.number));
  }
  parameters.Add(damaged);
  const auto checks = DamagedChecks(connection, fence.key);
  if (!checks.ok()) return checks.status();
  const absl::StatusOr<ChecksHead> told = HeadOfRows(connection, fence.key);
  if (!told.ok()) return told.status();
  parameters.Add(*checks)
      .Add(Signed(told->checked_sequence))
      .Add(Signed(told->last_event));
  const auto rows = connection.Run(kDropDamaged, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteWritten(fence, revision);
    return absl::OkStatus();
  }
  return WhyNotWritten(connection, fence, NoBatchEndsAt(last_sequence));
}

absl::Status InsertPosePair(PostgresConnection& connection, const Fence& fence,
                            PairKind kind, const PosePairRecord& pair,
                            const std::optional<ChecksWrite>& checks,
                            std::uint64_t revision) {
  const PairStatements& statements = StatementsOf(kind);
  Parameters parameters = FenceOf(fence, revision);
  parameters.AddText(pair.id)
      .Add(kSharedRowFormat)
      .Add(Signed(pair.query_sequence))
      .Add(Signed(pair.matched_sequence))
      .Add(pair.create_time_ns)
      .Add(ChecksumOfPosePair(kSharedRowFormat, fence.key, kind, pair))
      .AddText(pair.payload);
  if (checks) AddChecks(fence.key, *checks, &parameters);
  const auto rows = connection.Run(
      checks ? statements.insert_with_checks : statements.insert, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteWritten(fence, revision);
    return absl::OkStatus();
  }
  return WhyPairNotWritten(connection, fence, kind, pair.id, checks,
                           /*was_there=*/true, PairExists(kind, pair.id));
}

absl::Status RemovePosePair(PostgresConnection& connection, const Fence& fence,
                            DeletedPairRecord deleted,
                            const std::optional<ChecksWrite>& checks,
                            std::uint64_t revision) {
  const auto last = connection.Run(kLastNumber, Parameters().Add(fence.key));
  if (!last.ok()) return last.status();
  const auto number = NumberAfter(last->Integer(0, 0));
  if (!number.ok()) return number.status();
  deleted.number = *number;
  const PosePairRecord& pair = deleted.pair;
  const PairStatements& statements = StatementsOf(deleted.kind);
  Parameters parameters = FenceOf(fence, revision);
  parameters.AddText(pair.id)
      .Add(Signed(deleted.number))
      .Add(NumberOf(deleted.kind))
      .Add(kSharedRowFormat)
      .Add(Signed(pair.query_sequence))
      .Add(Signed(pair.matched_sequence))
      .Add(pair.create_time_ns)
      .Add(deleted.delete_time_ns)
      .Add(ChecksumOfDeletedPair(kSharedRowFormat, fence.key, deleted))
      .AddText(pair.payload)
      .Add(std::int64_t{kMostDeletedPairs - 1});
  if (checks) AddChecks(fence.key, *checks, &parameters);
  const auto rows = connection.Run(
      checks ? statements.remove_with_checks : statements.remove, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) {
    NoteWritten(fence, revision);
    return absl::OkStatus();
  }
  return WhyPairNotWritten(connection, fence, deleted.kind, pair.id, checks,
                           /*was_there=*/false,
                           NoSuchPair(deleted.kind, pair.id));
}

absl::Status ConfirmHead(PostgresConnection& connection, const Fence& fence) {
  const auto rows = connection.Run(kHeadHolds, FenceOf(fence));
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  return WhyNotWritten(connection, fence, Fenced("the vehicle"));
}

absl::StatusOr<bool> PurgeSome(PostgresConnection& connection) {
  const auto rows = connection.Run(kPurge);
  if (!rows.ok()) return rows.status();
  return rows->size() > 0;
}

}  // namespace revisit::server
