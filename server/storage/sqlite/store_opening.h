// The steps of opening a store, and the tables of a new one: whether the file
// is a store, of which format, and whether it and its log are whole.
// sqlite_storage.h says in which order and what for.
//
// Errors, besides those of the device: FAILED_PRECONDITION for a file that is
// no store, or one of a newer format; DATA_LOSS (STORE_CORRUPT) for damage. The
// messages are for operators.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {

// Whether the files of a store belong together, and hold all that was flushed.
struct StoreExamination {
  // Empty if they do; otherwise what is wrong, in one line that names the file.
  std::string damage;
  // Whether the store can be opened all the same, with the contents of its
  // database and of the sound part of its log. It cannot if SQLite would
  // combine files that do not belong together.
  bool can_be_dropped = false;
  // Vehicles with changes that are only in the damaged part of the log, as far
  // as they are known.
  std::set<std::string> vehicles;
  // Whether the log ends in a write that was never acknowledged.
  bool has_unfinished_tail = false;
  // Whether the database alone is the whole store.
  bool has_no_log = false;
};

// OK if there is a database that is not empty. DATA_LOSS (STORE_CORRUPT) if it
// is empty, or missing beside other files of the store; NOT_FOUND if there is
// nothing at all.
absl::Status CheckDatabaseIsThere(const std::string& store);

// Examines a store that no server has, before SQLite opens it: SQLite would
// silently end a log at the first damage, apply one of another store, or remove
// it beside an empty database. Writes nothing.
absl::StatusOr<StoreExamination> ExamineStore(const std::string& store);

// DATA_LOSS (STORE_CORRUPT) with the damage and the vehicles.
absl::Status DamageOf(const StoreExamination& examination);

// Examines the store for a server that has its lock: DATA_LOSS (STORE_CORRUPT)
// if something is wrong, unless `drop_damaged_log` is set and the damage can be
// dropped. `warn` may be empty.
absl::Status CheckStoreFiles(
    const std::string& store, bool drop_damaged_log,
    const std::function<void(const std::string&)>& warn, DurableMark* mark);

// Makes a new store, whole or not at all. REQUIRES: there is none. If another
// server makes one at the same time, that one may be there afterwards.
absl::Status MakeStore(const std::string& store, const std::string& vfs,
                       std::uint64_t run);

struct OpenedWriter {
  std::unique_ptr<SqliteDatabase> database;
  StoreState state;
  // Whether everything in the log is in the file and flushed there too. If not,
  // because of readers or for want of room, the log is as it was.
  bool is_copied = false;
};

// Opens the connection that writes. Brings an older store to this format, and
// copies the log into the file, if asked to. `vfs` is as in SqliteOptions.
absl::StatusOr<OpenedWriter> OpenWriter(const std::string& store,
                                        const std::string& vfs,
                                        std::uint64_t run, DurableMark* mark,
                                        bool copies_log);

// The mode for reading a store to which nobody writes.
inline SqliteDatabase::Mode ReadingMode(bool has_no_log) {
  return has_no_log ? SqliteDatabase::Mode::kFileOnly
                    : SqliteDatabase::Mode::kReadOnly;
}

// Opens a connection that reads, and so keeps the log and its index open.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs);

// Checks that the structure of a file hides no row, unless the file is larger
// than the bound; the message names the vehicles with hidden rows.
absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       std::int64_t max_checked_bytes);

// Opens a store of this format to read it whole (store_check.h,
// store_backup.h), also while a server has it open.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path, SqliteDatabase::Mode mode);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_
