// Opening a store: whether the file is one, of which format, and whether it and
// its log are whole. sqlite_storage.h says in which order and what for; here
// are the steps, and the tables of a new store.
//
// Errors, besides those of the device: FAILED_PRECONDITION for a file that is
// no store, or one of a newer format; DATA_LOSS (STORE_CORRUPT) for damage. The
// messages are for operators.
#ifndef REVISIT_SERVER_STORAGE_STORE_OPENING_H_
#define REVISIT_SERVER_STORAGE_STORE_OPENING_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/durable_mark.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/store_state.h"

namespace revisit::server {

// Whether the files of a store belong together, and hold all that was flushed.
struct StoreExamination {
  // Empty if so; else what is wrong, in one line that names the file.
  std::string damage;
  // Whether the store can be opened all the same, with what its database and
  // the sound part of its log hold: not where SQLite would put together what
  // does not belong together.
  bool can_be_dropped = false;
  // Those with changes in the damaged part of the log that are nowhere else, as
  // far as can be told.
  std::set<std::string> vehicles;
  // Whether the log ends in a write that was never acknowledged.
  bool has_unfinished_tail = false;
  // Whether the database alone is the whole store.
  bool has_no_log = false;
};

// What is wrong if there is no database, or an empty one: DATA_LOSS
// (STORE_CORRUPT) where other files of the store are there or it is empty,
// NOT_FOUND where there is nothing at all.
absl::Status CheckDatabaseIsThere(const std::string& store);

// Of a store that no server has, before SQLite has opened it: SQLite would end
// a log silently at the first damage, apply one of another store, or remove it
// beside an empty database. Writes nothing.
absl::StatusOr<StoreExamination> ExamineStore(const std::string& store);

// DATA_LOSS (STORE_CORRUPT): the damage, with the vehicles.
absl::Status DamageOf(const StoreExamination& examination);

// The same for a server that has the lock: DATA_LOSS (STORE_CORRUPT) if
// something is wrong, unless it can be dropped and `drop_damaged_log`. `warn`
// may be empty.
absl::Status CheckStoreFiles(
    const std::string& store, bool drop_damaged_log,
    const std::function<void(const std::string&)>& warn, DurableMark* mark);

// Makes a new store, whole or not at all. REQUIRES: there is none. Another
// server may be making it at the same time; then its is there afterwards.
absl::Status MakeStore(const std::string& store, const std::string& vfs,
                       std::uint64_t run);

struct OpenedWriter {
  std::unique_ptr<SqliteDatabase> database;
  StoreState state;
  // Whether all that is in the log is in the file and flushed there too. If
  // not, for there are readers or no room, the log is as it was.
  bool is_copied = false;
};

// The connection that writes. Brings an older store to this format, and copies
// what the log holds into the file, if told to. `vfs` as in SqliteOptions.
absl::StatusOr<OpenedWriter> OpenWriter(const std::string& store,
                                        const std::string& vfs,
                                        std::uint64_t run, DurableMark* mark,
                                        bool copies_log);

// How to read a store that nobody writes to.
inline SqliteDatabase::Mode ReadingMode(bool has_no_log) {
  return has_no_log ? SqliteDatabase::Mode::kFileOnly
                    : SqliteDatabase::Mode::kReadOnly;
}

// A connection that reads, and so holds the log and its index.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs);

// Whether a file that is not larger than that can be trusted to hide nothing;
// the message names the vehicles that it hides.
absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       std::int64_t max_checked_bytes);

// A store of this format, for whoever reads it whole (store_check.h,
// store_backup.h), also while a server has it open.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path, SqliteDatabase::Mode mode);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_OPENING_H_
