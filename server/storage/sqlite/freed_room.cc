#include "server/storage/sqlite/freed_room.h"

#include <algorithm>
#include <string>

#include "server/storage/sqlite/snapshot_rows.h"

namespace revisit::server {
namespace {

// A part of a snapshot takes as much room as so many large batches.
constexpr int kBatchesPerPart = 8;

// Whether pages can be given back, which was decided when the file was made.
absl::StatusOr<bool> CanShrink(SqliteDatabase& database) {
  constexpr std::int64_t kIncremental = 2;
  const absl::StatusOr<std::int64_t> mode =
      database.QueryInteger("PRAGMA auto_vacuum");
  if (!mode.ok()) return mode.status();
  return *mode == kIncremental;
}

}  // namespace

absl::StatusOr<bool> PurgeSome(SqliteDatabase& database, int batches) {
  VehicleKey key = 0;
  {
    SqliteStatement row =
        database.Prepare("SELECT key FROM deleted_vehicles LIMIT 1");
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) {
      return PurgeSnapshots(database, std::max(1, batches / kBatchesPerPart));
    }
    key = row.Integer(0);
  }
  int removed = 0;
  for (const char* sql :
       {"DELETE FROM batches WHERE rowid IN (SELECT rowid FROM batches WHERE "
        "vehicle_key = ?1 LIMIT ?2)",
        "DELETE FROM revised_batches WHERE rowid IN (SELECT rowid FROM "
        "revised_batches WHERE vehicle_key = ?1 LIMIT ?2)"}) {
    const absl::Status status =
        database.Prepare(sql).Bind(1, key).Bind(2, batches).Run();
    if (!status.ok()) return status;
    removed += database.Changes();
  }
  if (removed == 0) {
    const absl::Status status =
        database.Prepare("DELETE FROM deleted_vehicles WHERE key = ?1")
            .Bind(1, key)
            .Run();
    if (!status.ok()) return status;
  }
  return true;
}

absl::StatusOr<std::int64_t> GiveBackPages(SqliteDatabase& database,
                                           std::int64_t kept,
                                           std::int64_t most) {
  static constexpr char kFree[] = "PRAGMA freelist_count";
  const absl::StatusOr<bool> shrinks = CanShrink(database);
  if (!shrinks.ok()) return shrinks.status();
  if (!*shrinks) return 0;
  const absl::StatusOr<std::int64_t> before = database.QueryInteger(kFree);
  if (!before.ok()) return before.status();
  if (*before <= kept) return 0;
  const std::int64_t pages = std::min(most, *before - kept);
  const absl::Status status = database.Execute(
      ("PRAGMA incremental_vacuum(" + std::to_string(pages) + ")").c_str());
  if (!status.ok()) return status;
  const absl::StatusOr<std::int64_t> after = database.QueryInteger(kFree);
  if (!after.ok()) return after.status();
  return *before - *after;
}

absl::Status SetShrinking(SqliteDatabase& database) {
  const absl::StatusOr<bool> shrinks = CanShrink(database);
  if (!shrinks.ok() || *shrinks) return shrinks.status();
  return database.Execute("PRAGMA auto_vacuum = INCREMENTAL");
}

}  // namespace revisit::server
