// The tables in PostgreSQL, as numbered migrations: each brings a database from
// the version before to its own. A server never changes the tables; `revisitd
// migrate` does, before the first server of a new version starts.
//
// Every migration leaves tables that the servers of the version before can go
// on with ("expand"), so that servers can be replaced one by one; what they
// alone needed is removed by a later one ("contract"). A server takes a
// database of its own version and of the one before, and refuses others.
//
// Tables of version 1:
//   schema_version       one row
//   servers              a row per start of a server; see ownership.h
//   vehicles             a row per vehicle; keys are never used again
//   heads                who writes a vehicle, and up to where it is stored;
//                        narrow, because every write changes it
//   handovers            vehicles that a server wants of another
//   batches, revised_batches, loop_closures, rejected_candidates
//                        as in sqlite_storage.h
//   deleted_vehicles     keys whose batches are still to be removed
// and since version 2:
//   snapshots, snapshot_parts, deleted_snapshots
//                        as in sqlite_storage.h; triggers remove the snapshot
//                        of a vehicle with the vehicle, and when a batch of it
//                        is revised or removed
// and since version 3 in `servers`:
//   vehicles             how many it owned at its last beat; 0 of a server of
//                        the version before
// Rows have the format versions and checksums of record_checksum.h, except
// those of heads: they are compared with the last batch whenever a vehicle is
// read.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"

namespace revisit::server {

inline constexpr int kSchemaVersion = 3;
inline constexpr int kOldestSchemaVersion = 2;
// The version that brought servers.vehicles.
inline constexpr int kVehicleCountsSinceVersion = 3;

// The version of the tables. FAILED_PRECONDITION if this program does not know
// them; the message says what to run.
absl::StatusOr<int> CheckSchema(PostgresConnection& connection);

struct MigrationReport {
  int version_before = 0;  // 0: the database had no tables.
  int version_after = 0;
};

// Brings the tables to a version, unless they are there already, each migration
// whole or not at all. Of several that run at a time, one works and the others
// wait. The role needs the right to create tables. FAILED_PRECONDITION if the
// tables are newer than this program. Versions before the last are for tests of
// how it gets on with them.
absl::StatusOr<MigrationReport> MigrateDatabase(
    const std::string& conninfo, int to_version = kSchemaVersion);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_MIGRATIONS_H_
