#include "server/storage/sqlite/store_format.h"

#include <cstdint>
#include <map>
#include <memory>
#include <string>

#include "server/base/status.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {
namespace {

// "RVST", which marks an SQLite file as a store.
constexpr std::int64_t kApplicationId = 0x52565354;

// Page size of a new store. A batch of 64 poses has some 12 kB: with such
// batches the store takes in a quarter more than with SQLite's own 4096, and
// with 16384 the file grows by a third.
constexpr int kPageBytes = 8192;

// Payloads come last, so that the columns before them are read without them.
// Those of pairs are added as they were once, since SQLite keeps the text of
// the statement, and CheckSchema() compares it. `store` has one row
// (store_state.h). Keep in step: kStoreFormat, the list in sqlite_storage.h,
// record_checksum.h.
constexpr char kTablesOf4[] = R"sql(
CREATE TABLE vehicles (
  key INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL
);
CREATE TABLE batches (
  vehicle_key INTEGER NOT NULL,
  first_sequence INTEGER NOT NULL,
  count INTEGER NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, first_sequence)
);
CREATE TABLE revised_batches (
  vehicle_key INTEGER NOT NULL,
  first_sequence INTEGER NOT NULL,
  count INTEGER NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, first_sequence)
);
CREATE TABLE loop_closures (
  vehicle_key INTEGER NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY (vehicle_key, id)
) WITHOUT ROWID;
CREATE TABLE deleted_vehicles (
  key INTEGER PRIMARY KEY
);
CREATE TABLE rejected_candidates (
  vehicle_key INTEGER NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY (vehicle_key, id)
) WITHOUT ROWID;
CREATE TABLE store (
  key INTEGER PRIMARY KEY,
  state BLOB NOT NULL
);
ALTER TABLE loop_closures ADD COLUMN payload BLOB NOT NULL DEFAULT x'';
ALTER TABLE rejected_candidates ADD COLUMN payload BLOB NOT NULL DEFAULT x'';
)sql";

// The tables that format 5 has beyond format 4.
constexpr char kAddedBy5[] = R"sql(
CREATE TABLE snapshots (
  key INTEGER PRIMARY KEY AUTOINCREMENT,
  vehicle_key INTEGER NOT NULL UNIQUE,
  format INTEGER NOT NULL,
  last_sequence INTEGER NOT NULL,
  part_count INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL
);
CREATE TABLE snapshot_parts (
  snapshot_key INTEGER NOT NULL,
  number INTEGER NOT NULL,
  format INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (snapshot_key, number)
);
CREATE TABLE deleted_snapshots (
  key INTEGER PRIMARY KEY
);
)sql";

// The table that format 6 has beyond format 5.
constexpr char kAddedBy6[] = R"sql(
CREATE TABLE deleted_pose_pairs (
  vehicle_key INTEGER NOT NULL,
  number INTEGER NOT NULL,
  kind INTEGER NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  delete_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, number)
) WITHOUT ROWID;
)sql";

// The tables that format 7 has beyond format 6. Rows of `checks` have a column
// more than those of batches, so that what is read of a damaged log can be told
// apart (write_ahead_log.cc).
constexpr char kAddedBy7[] = R"sql(
CREATE TABLE check_heads (
  vehicle_key INTEGER PRIMARY KEY,
  format INTEGER NOT NULL,
  stores INTEGER NOT NULL,
  checked_sequence INTEGER NOT NULL,
  last_event INTEGER NOT NULL,
  checksum INTEGER NOT NULL
);
CREATE TABLE checks (
  vehicle_key INTEGER NOT NULL,
  sequence INTEGER NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  open_count INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, sequence)
);
CREATE TABLE events (
  id INTEGER PRIMARY KEY AUTOINCREMENT,
  vehicle_key INTEGER NOT NULL,
  number INTEGER NOT NULL,
  format INTEGER NOT NULL,
  time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  UNIQUE (vehicle_key, number)
);
CREATE TABLE dropped_events (
  key INTEGER PRIMARY KEY,
  id INTEGER NOT NULL,
  vehicle_key INTEGER NOT NULL,
  number INTEGER NOT NULL,
  checksum INTEGER NOT NULL
);
)sql";

// The tables that format 8 has beyond format 7. No row of them has the columns
// of a vehicle, a batch or a pair, for the same reason. The unique columns are
// those by which a vehicle's rows are found.
constexpr char kAddedBy8[] = R"sql(
CREATE TABLE vehicle_groups (
  id TEXT PRIMARY KEY NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  uid TEXT NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL
) WITHOUT ROWID;
CREATE TABLE group_members (
  group_id TEXT NOT NULL,
  vehicle_key INTEGER NOT NULL,
  format INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (group_id, vehicle_key),
  UNIQUE (vehicle_key, group_id)
) WITHOUT ROWID;
CREATE TABLE group_links (
  group_id TEXT NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  state INTEGER NOT NULL,
  query_vehicle INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_vehicle INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (group_id, id),
  UNIQUE (query_vehicle, group_id, id),
  UNIQUE (matched_vehicle, group_id, id)
) WITHOUT ROWID;
)sql";

// Format 9 has no table beyond format 8: its batches may hold columns, which
// servers of the formats before would take for batches without poses.

// Lets pages of deleted rows be given back to the file system. Works only for a
// file without tables.
constexpr char kVacuum[] = "PRAGMA auto_vacuum = INCREMENTAL";

std::string AllTables() {
  return std::string(kTablesOf4) + kAddedBy5 + kAddedBy6 + kAddedBy7 +
         kAddedBy8;
}

}  // namespace

absl::StatusOr<FileFormat> ReadFormat(SqliteDatabase& database) {
  const absl::StatusOr<std::int64_t> application =
      database.QueryInteger("PRAGMA application_id");
  if (!application.ok()) return application.status();
  const absl::StatusOr<std::int64_t> version =
      database.QueryInteger("PRAGMA user_version");
  if (!version.ok()) return version.status();
  return FileFormat{*application, *version};
}

absl::Status CheckKnownFormat(const std::string& path,
                              const FileFormat& format) {
  if (format.application != kApplicationId) {
    return absl::FailedPreconditionError(path +
                                         " is an SQLite file of another "
                                         "program, not a store of revisit");
  }
  if (format.version < kOldestStoreFormat || format.version > kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(format.version) +
        ", this server reads formats " + std::to_string(kOldestStoreFormat) +
        " to " + std::to_string(kStoreFormat) +
        (format.version > kStoreFormat ? ": use a newer server" : ""));
  }
  return absl::OkStatus();
}

absl::Status MakeTables(SqliteDatabase& database, std::uint64_t run) {
  absl::Status status = database.Execute(
      ("PRAGMA page_size = " + std::to_string(kPageBytes) + ";" + kVacuum +
       "; BEGIN IMMEDIATE;" + AllTables() +
       "PRAGMA application_id = " + std::to_string(kApplicationId) +
       "; PRAGMA user_version = " + std::to_string(kStoreFormat))
          .c_str());
  if (status.ok()) status = WriteState(database, FirstState(run));
  if (status.ok()) status = database.Execute("COMMIT");
  return status;
}

absl::Status BringToStoreFormat(SqliteDatabase& database,
                                const std::string& path, std::uint64_t run) {
  const absl::StatusOr<FileFormat> format = ReadFormat(database);
  if (!format.ok()) return format.status();
  const absl::Status known = CheckKnownFormat(path, *format);
  if (!known.ok()) return known;
  if (format->version == kStoreFormat) return absl::OkStatus();
  // Nothing is changed before the commit: a failure closes the connection,
  // which rolls back.
  std::string sql = "BEGIN IMMEDIATE;";
  if (format->version < 5) sql += kAddedBy5;
  if (format->version < 6) sql += kAddedBy6;
  if (format->version < 7) sql += kAddedBy7;
  if (format->version < 8) sql += kAddedBy8;
  sql += "PRAGMA user_version = " + std::to_string(kStoreFormat);
  absl::Status status = database.Execute(sql.c_str());
  if (!status.ok()) return status;
  const absl::StatusOr<StoreState> stored = ReadState(database);
  if (!stored.ok()) return stored.status();
  status = WriteState(database, NextState(*stored, run, /*is_closed=*/false));
  if (!status.ok()) return status;
  return database.Execute("COMMIT");
}

absl::Status CheckSchema(SqliteDatabase& database, const std::string& path) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> expected =
      SqliteDatabase::Open(":memory:", SqliteDatabase::Mode::kReadWrite, "");
  if (!expected.ok()) return expected.status();
  const absl::Status made = (*expected)->Execute(AllTables().c_str());
  if (!made.ok()) return made;
  static constexpr char kTables[] =
      "SELECT name, sql FROM sqlite_schema WHERE type = 'table'";
  const auto read =
      [](SqliteDatabase& from,
         std::map<std::string, std::string>* tables) -> absl::Status {
    SqliteStatement row = from.Prepare(kTables);
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found) return absl::OkStatus();
      (*tables)[row.Bytes(0)] = row.Bytes(1);
    }
  };
  std::map<std::string, std::string> ours;
  std::map<std::string, std::string> theirs;
  absl::Status status = read(**expected, &ours);
  if (status.ok()) status = read(database, &theirs);
  if (!status.ok()) return status;
  for (const auto& [name, sql] : ours) {
    const auto found = theirs.find(name);
    if (found == theirs.end() || found->second != sql) {
      return Corrupt("the store " + path + " is damaged: its table " + name +
                         " is not as it was made",
                     {});
    }
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
