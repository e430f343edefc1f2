// The tables in PostgreSQL, as numbered migrations: each brings a database from
// the version before to its own. A server never changes the tables; `revisitd
// migrate` does, before the first server of a new version starts.
//
// Every migration leaves tables that the servers of the version before can go
// on with ("expand"), so that servers can be replaced one by one; what they
// alone needed is removed by a later one ("contract"). A server takes a
// database of its own version and of the one before, and refuses others.
//
// Tables:
//   schema_version       one row
//   servers              a row per start of a server; see ownership.h
//   vehicles             a row per vehicle; keys are never used again
//   heads                who writes a vehicle, and up to where it is stored;
//                        narrow, because every write changes it
//   handovers            vehicles that a server wants of another
//   batches, revised_batches, loop_closures, rejected_candidates, snapshots,
//   snapshot_parts, deleted_snapshots, deleted_pose_pairs, checks, events
//                        as in sqlite_storage.h; the last two since version 6.
//                        Events are in the order of the transactions that wrote
//                        them: postgres_checks.h
//   dropped_events       one row: the last event that was dropped, with all
//                        before it; that before all events if none was; since
//                        version 6
//   vehicle_groups, group_members, group_links
//                        as in sqlite_storage.h; since version 7
//   deleted_vehicles     keys whose batches are still to be removed
// Rows have the format versions and checksums of record_checksum.h, except
// those of heads: they are compared with the last batch whenever a vehicle is
// read. Since version 6, heads also have how far the stored checks of a vehicle
// have come.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"

namespace revisit::server {

inline constexpr int kSchemaVersion = 7;
// Versions before the first were never in a release, and are refused.
inline constexpr int kFirstSchemaVersion = 4;
// The oldest that a server takes: the version before the last.
inline constexpr int kOldestSchemaVersion = 6;

// FAILED_PRECONDITION if this program does not know the tables; the message
// says what to run.
absl::Status CheckSchema(PostgresConnection& connection);

struct MigrationReport {
  int version_before = 0;  // 0: the database had no tables.
  int version_after = 0;
};

// Brings the tables to the last version, unless they are there already, each
// migration whole or not at all. Of several that run at a time, one works and
// the others wait. The role needs the right to create tables.
// FAILED_PRECONDITION if the tables are newer than this program, or older than
// the first version.
absl::StatusOr<MigrationReport> MigrateDatabase(const std::string& conninfo);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_
