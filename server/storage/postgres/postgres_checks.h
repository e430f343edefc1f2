// The statements that write and read checks and events (migrations.h). Each
// write is one statement, and fenced, as in postgres_changes.h; DropOldEvents()
// excepted, which needs no owner.
//
// Events are in the order of the transactions that wrote them. One is told only
// once its transaction is older than every transaction that still runs
// (pg_snapshot_xmin()): then no other can come to stand before it, because a
// transaction that has no number yet gets a greater one. An event of a vehicle
// is written only after the one before was acknowledged, since each write names
// the last number that it builds on, and a transaction gets its number with its
// first write. Hence REQUIRED of every transaction that writes events: that it
// writes nothing before the fence, so that later events of a vehicle are also
// later in the order.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECKS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECKS_H_

#include <cstdint>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_fence.h"
#include "server/storage/records.h"

namespace revisit::server {

// ---- SQL: parts of a write that stores a ChecksWrite, whose arguments are its
// parameters ("$6" and so on) as AddChecks() adds them. HEAD is an array: the
// head of before (whether checks are stored, checked sequence, last event), the
// one from then on, and the format of rows.

// Assignments and conditions that a write adds to its fence, the update of the
// vehicle's row.
#define REVISIT_CHECKS_CHANGES(HEAD) \
  ", checks_stored = (" HEAD         \
  "::int8[])[4] <> 0, "              \
  "checked_sequence = (" HEAD        \
  "::int8[])[5], "                   \
  "last_event = (" HEAD "::int8[])[6]"
#define REVISIT_CHECKS_CONDITIONS(HEAD) \
  " AND checks_stored = ((" HEAD        \
  "::int8[])[1] <> 0) "                 \
  "AND checked_sequence = (" HEAD       \
  "::int8[])[2] "                       \
  "AND last_event = (" HEAD "::int8[])[3]"
// Statements that a write adds behind its fence. CHECKS and EVENTS are arrays
// too, of five numbers for each check (sequence, revision, open candidates,
// creation, checksum) and three for each event (number, time, checksum);
// REMOVED are sequences.
#define REVISIT_CHECKS_ROWS(HEAD, CHECKS, PAYLOADS, REMOVED, EVENTS,           \
                            EVENT_PAYLOADS)                                    \
  ", c AS (INSERT INTO checks (vehicle_key, format, sequence, revision, "      \
  "open_count, create_time_ns, checksum, payload) SELECT h.key, (" HEAD        \
  "::int8[])[7], (" CHECKS "::int8[])[5 * i - 4], (" CHECKS                    \
  "::int8[])[5 * i - 3], (" CHECKS "::int8[])[5 * i - 2], (" CHECKS            \
  "::int8[])[5 * i - 1], (" CHECKS                                             \
  "::int8[])[5 * i], p FROM h, unnest(" PAYLOADS                               \
  "::bytea[]) WITH ORDINALITY AS a(p, i) "                                     \
  "ON CONFLICT (vehicle_key, sequence) DO UPDATE SET "                         \
  "format = excluded.format, revision = excluded.revision, "                   \
  "open_count = excluded.open_count, "                                         \
  "create_time_ns = excluded.create_time_ns, "                                 \
  "checksum = excluded.checksum, payload = excluded.payload), "                \
  "g AS (DELETE FROM checks t USING h WHERE t.vehicle_key = h.key AND "        \
  "t.sequence = ANY(" REMOVED                                                  \
  "::int8[])), "                                                               \
  "w AS (INSERT INTO events (vehicle_key, format, number, time_ns, checksum, " \
  "payload) SELECT h.key, (" HEAD "::int8[])[7], (" EVENTS                     \
  "::int8[])[3 * i - 2], (" EVENTS "::int8[])[3 * i - 1], (" EVENTS            \
  "::int8[])[3 * i], p FROM h, unnest(" EVENT_PAYLOADS                         \
  "::bytea[]) WITH ORDINALITY AS a(p, i)) "

// Adds the values of HEAD, CHECKS, PAYLOADS, REMOVED, EVENTS and
// EVENT_PAYLOADS.
void AddChecks(VehicleKey key, const ChecksWrite& write,
               Parameters* parameters);

// ---- Writes

// Implements Storage::PutChecks().
absl::Status StoreChecks(PostgresConnection& connection, const Fence& fence,
                         const ChecksWrite& write);
// Implements Storage::DropEvents(). The first statement also gives up the
// events of a database that was restored from a dump in a server that counts
// transactions anew: they would stand behind those that are still to come.
absl::Status DropOldEvents(PostgresConnection& connection,
                           std::int64_t before_ns, int most);

// ---- Reads

// The head of the vehicle, if it is there; as GoneVehicle() otherwise.
absl::StatusOr<ChecksHead> FindChecksHead(PostgresConnection& connection,
                                          const Fence& fence);
// The head that the rows of a vehicle tell of, for where its own is lost.
absl::StatusOr<ChecksHead> HeadOfRows(PostgresConnection& connection,
                                      VehicleKey key);
// Sequences of all checks whose rows are damaged.
absl::StatusOr<std::vector<std::int64_t>> DamagedChecks(
    PostgresConnection& connection, VehicleKey key);

// These implement the calls of Storage.
absl::StatusOr<std::vector<CheckRecord>> FindChecks(
    PostgresConnection& connection, VehicleKey key,
    std::uint64_t first_sequence, std::uint64_t last_sequence, bool open_only,
    int limit);
// For this server.
absl::StatusOr<std::vector<VehicleRecord>> FindUnchecked(
    PostgresConnection& connection, const Uuid& server, VehicleKey after_key,
    int limit);
absl::StatusOr<std::vector<EventRecord>> FindEvents(
    PostgresConnection& connection, const EventPosition& after, int limit);
absl::StatusOr<EventPosition> FindLastEvent(PostgresConnection& connection);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECKS_H_
