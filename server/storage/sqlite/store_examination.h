// Whether the files of a store belong together and are whole, by what database,
// log, mark and lock say of it (store_state.h), before SQLite opens them.
//
// Errors, besides those of the device: DATA_LOSS (STORE_CORRUPT) for damage.
// The messages are for operators.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_EXAMINATION_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_EXAMINATION_H_

#include <functional>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/sqlite_database.h"

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

// Names of vehicles for a message: "a, b and 3 more".
std::string Listed(const std::set<std::string>& names);

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

// The mode for reading a store to which nobody writes.
inline SqliteDatabase::Mode ReadingMode(bool has_no_log) {
  return has_no_log ? SqliteDatabase::Mode::kFileOnly
                    : SqliteDatabase::Mode::kReadOnly;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_EXAMINATION_H_
