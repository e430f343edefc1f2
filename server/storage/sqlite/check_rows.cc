#include "server/storage/sqlite/check_rows.h"

#include <algorithm>
#include <limits>
#include <optional>
#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

absl::Status WriteChecksHead(SqliteDatabase& database, VehicleKey key,
                             const ChecksHead& head) {
  return database
      .Prepare(
          "INSERT INTO check_heads (vehicle_key, format, stores, "
          "checked_sequence, last_event, checksum) VALUES (?1, ?2, ?3, ?4, ?5, "
          "?6) ON CONFLICT (vehicle_key) DO UPDATE SET format = "
          "excluded.format, stores = excluded.stores, checked_sequence = "
          "excluded.checked_sequence, last_event = excluded.last_event, "
          "checksum = excluded.checksum")
      .Bind(1, key)
      .Bind(2, kStoreFormat)
      .Bind(3, head.stores ? 1 : 0)
      .Bind(4, Signed(head.checked_sequence))
      .Bind(5, Signed(head.last_event))
      .Bind(6, ChecksumOfChecksHead(kStoreFormat, key, head))
      .Run();
}

absl::Status WriteCheck(SqliteDatabase& database, VehicleKey key,
                        const CheckRecord& check) {
  return database
      .Prepare(
          "INSERT OR REPLACE INTO checks (vehicle_key, sequence, format, "
          "revision, open_count, create_time_ns, checksum, payload) VALUES "
          "(?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")
      .Bind(1, key)
      .Bind(2, Signed(check.sequence))
      .Bind(3, kStoreFormat)
      .Bind(4, Signed(check.revision))
      .Bind(5, static_cast<std::int64_t>(check.open_count))
      .Bind(6, check.create_time_ns)
      .Bind(7, ChecksumOfCheck(kStoreFormat, key, check))
      .BindBlob(8, check.payload)
      .Run();
}

absl::Status RemoveCheck(SqliteDatabase& database, VehicleKey key,
                         std::uint64_t sequence) {
  return database
      .Prepare("DELETE FROM checks WHERE vehicle_key = ?1 AND sequence = ?2")
      .Bind(1, key)
      .Bind(2, Signed(sequence))
      .Run();
}

absl::Status InsertEvent(SqliteDatabase& database, VehicleKey key,
                         const EventRecord& event) {
  return database
      .Prepare(
          "INSERT INTO events (vehicle_key, number, format, time_ns, checksum, "
          "payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6)")
      .Bind(1, key)
      .Bind(2, Signed(event.number))
      .Bind(3, kStoreFormat)
      .Bind(4, event.time_ns)
      .Bind(5, ChecksumOfEvent(kStoreFormat, key, event))
      .BindBlob(6, event.payload)
      .Run();
}

// The greatest value of a column among the rows of a vehicle; 0 if it has none.
absl::StatusOr<std::uint64_t> Greatest(SqliteDatabase& database,
                                       const char* sql, VehicleKey key) {
  SqliteStatement row = database.Prepare(sql);
  const absl::StatusOr<bool> found = row.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  return Unsigned(row.Integer(0));
}

// A head that fits what is stored of a vehicle whose own one is damaged.
absl::StatusOr<ChecksHead> MakeHead(SqliteDatabase& database, VehicleKey key) {
  const auto checked = Greatest(database,
                                "SELECT coalesce(max(sequence), 0) FROM checks "
                                "WHERE vehicle_key = ?1",
                                key);
  if (!checked.ok()) return checked.status();
  const auto event = Greatest(
      database,
      "SELECT coalesce(max(number), 0) FROM events WHERE vehicle_key = ?1",
      key);
  if (!event.ok()) return event.status();
  return ChecksHead{true, *checked, *event};
}

// The position behind the last event that was dropped.
absl::StatusOr<EventPosition> FindDropped(SqliteDatabase& database) {
  SqliteStatement row = database.Prepare(
      "SELECT id, vehicle_key, number, checksum FROM dropped_events");
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return EventPosition();
  return EventPosition{Unsigned(row.Integer(0)), row.Integer(1),
                       Unsigned(row.Integer(2)), row.Integer(3)};
}

}  // namespace

absl::StatusOr<ChecksHead> FindChecksHead(SqliteDatabase& database,
                                          VehicleKey key) {
  SqliteStatement row = database.Prepare(
      "SELECT format, stores, checked_sequence, last_event, checksum FROM "
      "check_heads WHERE vehicle_key = ?1");
  const absl::StatusOr<bool> found = row.Bind(1, key).Step();
  if (!found.ok()) return found.status();
  ChecksHead head;
  if (!*found) return head;
  head.stores = row.Integer(1) != 0;
  head.checked_sequence = Unsigned(row.Integer(2));
  head.last_event = Unsigned(row.Integer(3));
  absl::Status sound =
      CheckChecksHeadRow(row.Integer(0), row.Integer(4), key, head);
  if (!sound.ok()) return sound;
  return head;
}

absl::Status StoreChecks(SqliteDatabase& database, VehicleKey key,
                         const ChecksWrite& write) {
  const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  const absl::StatusOr<ChecksHead> head = FindChecksHead(database, key);
  if (!head.ok()) return head.status();
  if (*head != write.before) return OtherChecksHead(*head, write.before);
  absl::Status status = WriteChecksHead(database, key, write.after);
  for (const std::uint64_t sequence : write.removed) {
    if (status.ok()) status = RemoveCheck(database, key, sequence);
  }
  for (const CheckRecord& check : write.checks) {
    if (status.ok()) status = WriteCheck(database, key, check);
  }
  std::uint64_t number = write.before.last_event;
  for (EventRecord event : write.events) {
    event.number = ++number;
    if (status.ok()) status = InsertEvent(database, key, event);
  }
  return status;
}

absl::Status ImportChecks(SqliteDatabase& database, VehicleKey key,
                          const ChecksHead& head,
                          const std::vector<CheckRecord>& checks) {
  absl::Status status = WriteChecksHead(database, key, head);
  for (const CheckRecord& check : checks) {
    if (status.ok()) status = WriteCheck(database, key, check);
  }
  return status;
}

absl::Status DropDamagedChecks(SqliteDatabase& database, VehicleKey key,
                               std::uint64_t last_sequence) {
  absl::StatusOr<ChecksHead> head = FindChecksHead(database, key);
  const bool is_damaged = absl::IsDataLoss(head.status());
  if (is_damaged) head = MakeHead(database, key);
  if (!head.ok()) return head.status();
  if (!is_damaged && *head == ChecksHead()) return absl::OkStatus();
  head->checked_sequence = std::min(head->checked_sequence, last_sequence);
  absl::Status status = WriteChecksHead(database, key, *head);
  if (!status.ok()) return status;
  status =
      database
          .Prepare(
              "DELETE FROM checks WHERE vehicle_key = ?1 AND sequence > ?2")
          .Bind(1, key)
          .Bind(2, Signed(last_sequence))
          .Run();
  if (!status.ok()) return status;
  const auto left =
      FindChecks(database, key, 0, last_sequence,
                 /*open_only=*/false, std::numeric_limits<int>::max());
  if (!left.ok()) return left.status();
  for (const CheckRecord& check : *left) {
    if (check.damage.ok()) continue;
    status = RemoveCheck(database, key, check.sequence);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::Status RemoveChecks(SqliteDatabase& database, VehicleKey key,
                          EventRecord farewell) {
  const auto last = Greatest(
      database,
      "SELECT coalesce(max(number), 0) FROM events WHERE vehicle_key = ?1",
      key);
  if (!last.ok()) return last.status();
  const absl::StatusOr<ChecksHead> head = FindChecksHead(database, key);
  // All of its events may have been dropped already.
  const std::uint64_t number =
      std::max(*last, head.ok() ? head->last_event : std::uint64_t{0});
  for (const char* sql :
       {"DELETE FROM check_heads WHERE vehicle_key = ?1",
        "DELETE FROM checks WHERE vehicle_key = ?1",
        "UPDATE events SET payload = x'' WHERE vehicle_key = ?1"}) {
    const absl::Status status = database.Prepare(sql).Bind(1, key).Run();
    if (!status.ok()) return status;
  }
  if (number == 0) return absl::OkStatus();
  farewell.number = number + 1;
  return InsertEvent(database, key, farewell);
}

absl::StatusOr<std::vector<CheckRecord>> FindChecks(
    SqliteDatabase& database, VehicleKey key, std::uint64_t first_sequence,
    std::uint64_t last_sequence, bool open_only, int limit) {
  std::vector<CheckRecord> checks;
  const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
  if (!vehicle_id.ok()) return vehicle_id.status();
  SqliteStatement row = database.Prepare(
      "SELECT sequence, format, revision, open_count, create_time_ns, "
      "checksum, payload FROM checks WHERE vehicle_key = ?1 AND sequence "
      "BETWEEN ?2 AND ?3 AND "
      "(open_count <> 0 OR ?4 = 0) ORDER BY sequence LIMIT ?5");
  row.Bind(1, key)
      .Bind(2, Signed(std::min(first_sequence, kLastSequence)))
      .Bind(3, Signed(std::min(last_sequence, kLastSequence)))
      .Bind(4, open_only ? 1 : 0)
      .Bind(5, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return checks;
    CheckRecord& check = checks.emplace_back();
    check.sequence = Unsigned(row.Integer(0));
    check.revision = Unsigned(row.Integer(2));
    check.open_count = static_cast<std::uint32_t>(row.Integer(3));
    check.create_time_ns = row.Integer(4);
    check.payload = row.Bytes(6);
    CheckCheckRow(row.Integer(1), row.Integer(5), key, *vehicle_id, &check);
  }
}

absl::StatusOr<std::vector<VehicleRecord>> FindUnchecked(
    SqliteDatabase& database, VehicleKey after_key, int limit) {
  std::vector<VehicleRecord> owing;
  SqliteStatement row = database.Prepare(
      "SELECT vehicle_key, id, checked_sequence FROM check_heads JOIN vehicles "
      "ON key = vehicle_key WHERE vehicle_key > ?1 AND stores <> 0 ORDER BY "
      "vehicle_key");
  row.Bind(1, after_key);
  while (static_cast<int>(owing.size()) < limit) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) break;
    const VehicleKey key = row.Integer(0);
    const absl::StatusOr<std::uint64_t> end = ClaimedSequence(database, key);
    if (!end.ok()) return end.status();
    if (*end <= Unsigned(row.Integer(2))) continue;
    VehicleRecord& record = owing.emplace_back();
    record.key = key;
    record.id = row.Bytes(1);
    const absl::StatusOr<ChecksHead> head = FindChecksHead(database, key);
    if (head.ok()) record.checks = *head;
  }
  return owing;
}

absl::StatusOr<std::vector<EventRecord>> FindEvents(SqliteDatabase& database,
                                                    const EventPosition& after,
                                                    int limit) {
  std::vector<EventRecord> events;
  SqliteStatement row = database.Prepare(
      "SELECT id, vehicle_key, number, format, time_ns, checksum, payload FROM "
      "events WHERE id >= ?1 ORDER BY id LIMIT ?2");
  row.Bind(1, Signed(std::min(after.order, kLastSequence)))
      .Bind(2, static_cast<std::int64_t>(std::max(limit, 0)) + 1);
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) break;
    EventRecord& event = events.emplace_back();
    event.number = Unsigned(row.Integer(2));
    event.time_ns = row.Integer(4);
    event.payload = row.Bytes(6);
    CheckEventRow(row.Integer(3), row.Integer(5), row.Integer(1),
                  Unsigned(row.Integer(0)), &event);
  }
  if (!events.empty() && events.front().position == after) {
    events.erase(events.begin());
    return events;
  }
  // Read after the events: where it names the cursor now, it did so then.
  const absl::StatusOr<EventPosition> dropped = FindDropped(database);
  if (!dropped.ok()) return dropped.status();
  if (!(*dropped == after)) {
    return after.order < dropped->order ? CursorTooOld() : CursorUnknown();
  }
  if (static_cast<int>(events.size()) > limit) events.pop_back();
  return events;
}

absl::StatusOr<EventPosition> FindLastEvent(SqliteDatabase& database) {
  SqliteStatement row = database.Prepare(
      "SELECT id, vehicle_key, number, checksum FROM events ORDER BY id DESC "
      "LIMIT 1");
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return FindDropped(database);
  return EventPosition{Unsigned(row.Integer(0)), row.Integer(1),
                       Unsigned(row.Integer(2)), row.Integer(3)};
}

absl::Status DropOldEvents(SqliteDatabase& database, std::int64_t before_ns,
                           int most) {
  std::optional<EventPosition> last;
  {
    SqliteStatement row = database.Prepare(
        "SELECT id, vehicle_key, number, checksum, time_ns FROM events ORDER "
        "BY id LIMIT ?1");
    row.Bind(1, std::max(most, 0));
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found || row.Integer(4) >= before_ns) break;
      last = {Unsigned(row.Integer(0)), row.Integer(1),
              Unsigned(row.Integer(2)), row.Integer(3)};
    }
  }
  if (!last) return absl::OkStatus();
  const absl::Status status =
      database
          .Prepare(
              "INSERT OR REPLACE INTO dropped_events (key, id, vehicle_key, "
              "number, checksum) VALUES (1, ?1, ?2, ?3, ?4)")
          .Bind(1, Signed(last->order))
          .Bind(2, last->key)
          .Bind(3, Signed(last->number))
          .Bind(4, last->checksum)
          .Run();
  if (!status.ok()) return status;
  return database.Prepare("DELETE FROM events WHERE id <= ?1")
      .Bind(1, Signed(last->order))
      .Run();
}

}  // namespace revisit::server
