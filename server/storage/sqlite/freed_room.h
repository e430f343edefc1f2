// Room that a store no longer needs: rows that are out of reach, and pages that
// no row uses. See vehicle_rows.h.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_FREED_ROOM_H_
#define REVISIT_SERVER_STORAGE_SQLITE_FREED_ROOM_H_

#include <cstdint>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// Removes some rows of deleted vehicles and of deleted snapshots, with at most
// `batches` batches, or as many bytes of parts; returns whether more may be
// left.
absl::StatusOr<bool> PurgeSome(SqliteDatabase& database, int batches);

// Gives pages that no row uses back to the file system: those beyond `kept`,
// and at most `most` at a time, because other pages are moved to their places.
// Returns how many. Gives back none in a file that a server of format 1 or 2
// made and that was not compacted since.
absl::StatusOr<std::int64_t> GiveBackPages(SqliteDatabase& database,
                                           std::int64_t kept,
                                           std::int64_t most);
// Makes GiveBackPages() work in the file into which this one is vacuumed.
absl::Status SetShrinking(SqliteDatabase& database);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_FREED_ROOM_H_
