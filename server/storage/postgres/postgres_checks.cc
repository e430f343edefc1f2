#include "server/storage/postgres/postgres_checks.h"

#include <algorithm>
#include <limits>
#include <map>
#include <string>
#include <tuple>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

constexpr Statement kPutChecks = {
    "put_checks",
    REVISIT_FENCE(REVISIT_CHECKS_CHANGES("$6"), REVISIT_CHECKS_CONDITIONS("$6"))
        REVISIT_CHECKS_ROWS("$6", "$7", "$8", "$9", "$10",
                            "$11") "SELECT key FROM h"};

constexpr Statement kChecksHead = {
    "checks_head",
    "SELECT checks_stored, checked_sequence, last_event FROM heads "
    "WHERE key = $1::int8"};
constexpr Statement kHeadOfRows = {
    "checks_head_of_rows",
    "SELECT coalesce((SELECT max(sequence) FROM checks WHERE vehicle_key = "
    "$1::int8), 0)::int8, coalesce((SELECT max(number) FROM events WHERE "
    "vehicle_key = $1::int8), 0)::int8"};

// $1 key, $2 first and $3 last sequence, $4 whether with open candidates only,
// $5 limit. A row at least tells the vehicle's id.
constexpr Statement kListChecks = {
    "list_checks",
    "SELECT v.id, c.sequence, c.format, c.revision, c.open_count, "
    "c.create_time_ns, c.checksum, c.payload FROM vehicles v LEFT JOIN LATERAL "
    "(SELECT * FROM checks WHERE vehicle_key = $1::int8 AND sequence >= "
    "$2::int8 AND sequence <= $3::int8 AND (open_count <> 0 OR $4::int8 = 0) "
    "ORDER BY sequence LIMIT $5::int8) c ON true WHERE v.key = $1::int8 "
    "ORDER BY c.sequence"};
constexpr Statement kListUnchecked = {
    "list_unchecked",
    "SELECT h.key, v.id, h.checked_sequence, h.last_event FROM heads h "
    "JOIN vehicles v ON v.key = h.key WHERE h.checks_stored AND "
    "h.key > $1::int8 AND h.checked_sequence < h.durable_sequence "
    "AND NOT EXISTS (SELECT 1 FROM servers s WHERE s.incarnation = h.owner "
    "AND s.state = 'live' AND s.incarnation <> $3::uuid) "
    "ORDER BY h.key LIMIT $2::int8"};

// Whether an event is told; see the head of postgres_checks.h.
#define REVISIT_IS_FINAL "xid < pg_snapshot_xmin(pg_current_snapshot())"
// The mark of what was dropped, and the events from a position on, as of one
// moment. $1 order, $2 key, $3 number, $4 limit.
constexpr Statement kReadEvents = {
    "read_events",
    "SELECT d.xid, d.vehicle_key, d.number, d.checksum, e.xid, e.vehicle_key, "
    "e.number, e.format, e.time_ns, e.checksum, e.payload FROM dropped_events "
    "d LEFT JOIN LATERAL (SELECT * FROM events WHERE (xid, vehicle_key, "
    "number) >= ($1::xid8, $2::int8, $3::int8) AND " REVISIT_IS_FINAL
    " ORDER BY xid, vehicle_key, number LIMIT $4::int8) e ON true "
    "ORDER BY e.xid, e.vehicle_key, e.number"};
constexpr Statement kLastEvent = {
    "last_event",
    "SELECT d.xid, d.vehicle_key, d.number, d.checksum, e.xid, e.vehicle_key, "
    "e.number, e.checksum FROM dropped_events d LEFT JOIN LATERAL (SELECT * "
    "FROM events WHERE " REVISIT_IS_FINAL
    " ORDER BY xid DESC, vehicle_key DESC, number DESC LIMIT 1) e ON true"};

// Events of transactions that this server of PostgreSQL has not come to, all
// that it can see being older than its xmax, are gone with all others that are
// final; so are cursors at them. Those of transactions that still run stay. Of
// several servers, the one that finds the mark as it was does it.
constexpr Statement kDropForeignEvents = {
    "drop_foreign_events",
    "WITH s AS MATERIALIZED (SELECT pg_snapshot_xmin(pg_current_snapshot()) AS "
    "low, pg_snapshot_xmax(pg_current_snapshot()) AS high), "
    "f AS MATERIALIZED (SELECT low, high, xid AS was FROM s, dropped_events "
    "WHERE xid >= high OR EXISTS (SELECT 1 FROM events e WHERE e.xid >= "
    "high)), "
    "m AS (UPDATE dropped_events d SET xid = low, vehicle_key = 0, number = 0, "
    "checksum = 0 FROM f WHERE d.xid = was RETURNING low, high) "
    "DELETE FROM events e USING m WHERE e.xid < m.low OR e.xid >= m.high"};
// $1 time, $2 the most that go. The mark moves in the same step, and never
// back, where several servers drop at a time: who finds it further on than what
// it would drop drops nothing.
constexpr Statement kDropEvents = {
    "drop_events",
    "WITH l AS (SELECT * FROM (SELECT xid, vehicle_key, number, checksum, "
    "bool_and(time_ns < $1::int8) OVER (ORDER BY xid, vehicle_key, number) AS "
    "goes FROM (SELECT * FROM events WHERE " REVISIT_IS_FINAL
    " ORDER BY xid, vehicle_key, number LIMIT $2::int8) o) o WHERE goes "
    "ORDER BY xid DESC, vehicle_key DESC, number DESC LIMIT 1), "
    "m AS (UPDATE dropped_events d SET xid = l.xid, "
    "vehicle_key = l.vehicle_key, number = l.number, checksum = l.checksum "
    "FROM l WHERE (d.xid, d.vehicle_key, d.number) < (l.xid, l.vehicle_key, "
    "l.number) RETURNING d.xid, d.vehicle_key, d.number) "
    "DELETE FROM events e USING m WHERE (e.xid, e.vehicle_key, e.number) <= "
    "(m.xid, m.vehicle_key, m.number)"};
#undef REVISIT_IS_FINAL

// The columns from `column` on are xid, vehicle_key, number.
EventPosition PositionAt(const PostgresRows& rows, int row, int column,
                         int checksum_column) {
  return {Unsigned(rows.Integer(row, column)), rows.Integer(row, column + 1),
          Unsigned(rows.Integer(row, column + 2)),
          rows.Integer(row, checksum_column)};
}

bool IsBefore(const EventPosition& a, const EventPosition& b) {
  return std::tie(a.order, a.key, a.number) <
         std::tie(b.order, b.key, b.number);
}

absl::Status NoMark() {
  return Corrupt("the table dropped_events has no row", {});
}

}  // namespace

void AddChecks(VehicleKey key, const ChecksWrite& write,
               Parameters* parameters) {
  const std::vector<std::int64_t> head = {write.before.stores ? 1 : 0,
                                          Signed(write.before.checked_sequence),
                                          Signed(write.before.last_event),
                                          write.after.stores ? 1 : 0,
                                          Signed(write.after.checked_sequence),
                                          Signed(write.after.last_event),
                                          kSharedRowFormat};
  // A statement writes a row once: the last one of a sequence counts, and
  // nothing is removed that is put.
  std::map<std::uint64_t, const CheckRecord*> put;
  for (const CheckRecord& check : write.checks) put[check.sequence] = &check;
  std::vector<std::int64_t> checks;
  std::vector<const std::string*> payloads;
  for (const auto& [sequence, check] : put) {
    checks.insert(checks.end(),
                  {Signed(sequence), Signed(check->revision),
                   std::int64_t{check->open_count}, check->create_time_ns,
                   ChecksumOfCheck(kSharedRowFormat, key, *check)});
    payloads.push_back(&check->payload);
  }
  std::vector<std::int64_t> removed;
  for (const std::uint64_t sequence : write.removed) {
    if (put.count(sequence) == 0) removed.push_back(Signed(sequence));
  }
  std::vector<std::int64_t> events;
  std::vector<const std::string*> event_payloads;
  std::uint64_t number = write.before.last_event;
  for (const EventRecord& event : write.events) {
    EventRecord numbered = event;
    numbered.number = ++number;
    events.insert(events.end(),
                  {Signed(number), event.time_ns,
                   ChecksumOfEvent(kSharedRowFormat, key, numbered)});
    event_payloads.push_back(&event.payload);
  }
  parameters->Add(head)
      .Add(checks)
      .AddBytes(payloads)
      .Add(removed)
      .Add(events)
      .AddBytes(event_payloads);
}

absl::Status StoreChecks(PostgresConnection& connection, const Fence& fence,
                         const ChecksWrite& write) {
  Parameters parameters = FenceOf(fence, /*revision=*/0);
  AddChecks(fence.key, write, &parameters);
  const auto rows = connection.Run(kPutChecks, parameters);
  if (!rows.ok()) return rows.status();
  if (rows->size() > 0) return absl::OkStatus();
  const absl::StatusOr<ChecksHead> head = FindChecksHead(connection, fence);
  if (!head.ok()) return head.status();
  return WhyNotWritten(connection, fence, OtherChecksHead(*head, write.before));
}

absl::Status DropOldEvents(PostgresConnection& connection,
                           std::int64_t before_ns, int most) {
  const absl::Status status = connection.Run(kDropForeignEvents).status();
  if (!status.ok()) return status;
  return connection
      .Run(kDropEvents,
           Parameters().Add(before_ns).Add(std::int64_t{std::max(most, 0)}))
      .status();
}

absl::StatusOr<ChecksHead> FindChecksHead(PostgresConnection& connection,
                                          const Fence& fence) {
  const auto rows = connection.Run(kChecksHead, Parameters().Add(fence.key));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return GoneVehicle(fence);
  return ChecksHead{rows->Integer(0, 0) != 0, Unsigned(rows->Integer(0, 1)),
                    Unsigned(rows->Integer(0, 2))};
}

absl::StatusOr<ChecksHead> HeadOfRows(PostgresConnection& connection,
                                      VehicleKey key) {
  const auto rows = connection.Run(kHeadOfRows, Parameters().Add(key));
  if (!rows.ok()) return rows.status();
  return ChecksHead{true, Unsigned(rows->Integer(0, 0)),
                    Unsigned(rows->Integer(0, 1))};
}

absl::StatusOr<std::vector<std::int64_t>> DamagedChecks(
    PostgresConnection& connection, VehicleKey key) {
  const auto all =
      FindChecks(connection, key, 0, kLastSequence,
                 /*open_only=*/false, std::numeric_limits<int>::max());
  if (!all.ok()) return all.status();
  std::vector<std::int64_t> damaged;
  for (const CheckRecord& check : *all) {
    if (!check.damage.ok()) damaged.push_back(Signed(check.sequence));
  }
  return damaged;
}

absl::StatusOr<std::vector<CheckRecord>> FindChecks(
    PostgresConnection& connection, VehicleKey key,
    std::uint64_t first_sequence, std::uint64_t last_sequence, bool open_only,
    int limit) {
  std::vector<CheckRecord> checks;
  const auto rows = connection.Run(
      kListChecks, Parameters()
                       .Add(key)
                       .Add(Signed(std::min(first_sequence, kLastSequence)))
                       .Add(Signed(std::min(last_sequence, kLastSequence)))
                       .Add(std::int64_t{open_only ? 1 : 0})
                       .Add(std::int64_t{std::max(limit, 0)}));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return UnknownVehicle(key);
  if (rows->IsNull(0, 1)) return checks;
  const std::string vehicle_id = Printable(rows->Bytes(0, 0));
  for (int i = 0; i < rows->size(); ++i) {
    CheckRecord& check = checks.emplace_back();
    check.sequence = Unsigned(rows->Integer(i, 1));
    check.revision = Unsigned(rows->Integer(i, 3));
    check.open_count = static_cast<std::uint32_t>(rows->Integer(i, 4));
    check.create_time_ns = rows->Integer(i, 5);
    check.payload = rows->Bytes(i, 7);
    CheckCheckRow(rows->Integer(i, 2), rows->Integer(i, 6), key, vehicle_id,
                  &check);
  }
  return checks;
}

absl::StatusOr<std::vector<VehicleRecord>> FindUnchecked(
    PostgresConnection& connection, const Uuid& server, VehicleKey after_key,
    int limit) {
  std::vector<VehicleRecord> owing;
  const auto rows =
      connection.Run(kListUnchecked, Parameters()
                                         .Add(after_key)
                                         .Add(std::int64_t{std::max(limit, 0)})
                                         .Add(server));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) {
    VehicleRecord& record = owing.emplace_back();
    record.key = rows->Integer(i, 0);
    record.id = rows->Bytes(i, 1);
    record.checks = {true, Unsigned(rows->Integer(i, 2)),
                     Unsigned(rows->Integer(i, 3))};
  }
  return owing;
}

absl::StatusOr<std::vector<EventRecord>> FindEvents(
    PostgresConnection& connection, const EventPosition& after, int limit) {
  std::vector<EventRecord> events;
  const auto rows = connection.Run(
      kReadEvents, Parameters()
                       .Add(Signed(std::min(after.order, kLastSequence)))
                       .Add(after.key)
                       .Add(Signed(std::min(after.number, kLastSequence)))
                       .Add(static_cast<std::int64_t>(std::max(limit, 0)) + 1));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return NoMark();
  const EventPosition dropped = PositionAt(*rows, 0, 0, 3);
  for (int i = 0; i < rows->size() && !rows->IsNull(i, 4); ++i) {
    EventRecord& event = events.emplace_back();
    event.number = Unsigned(rows->Integer(i, 6));
    event.time_ns = rows->Integer(i, 8);
    event.payload = rows->Bytes(i, 10);
    CheckEventRow(rows->Integer(i, 7), rows->Integer(i, 9), rows->Integer(i, 5),
                  Unsigned(rows->Integer(i, 4)), &event);
  }
  if (!events.empty() && events.front().position == after) {
    events.erase(events.begin());
    return events;
  }
  if (!(dropped == after)) {
    return IsBefore(after, dropped) ? CursorTooOld() : CursorUnknown();
  }
  if (static_cast<int>(events.size()) > limit) events.pop_back();
  return events;
}

absl::StatusOr<EventPosition> FindLastEvent(PostgresConnection& connection) {
  const auto rows = connection.Run(kLastEvent);
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return NoMark();
  return rows->IsNull(0, 4) ? PositionAt(*rows, 0, 0, 3)
                            : PositionAt(*rows, 0, 4, 7);
}

}  // namespace revisit::server
