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
#include <optional>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/durable_mark.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/write_ahead_log.h"

namespace revisit::server {

// Whether a log holds all that was flushed.
struct LogExamination {
  // Empty if it does; else what is wrong, in one line.
  std::string damage;
  // Those with changes in the damaged part that are nowhere else, as far as can
  // be told.
  std::set<std::string> vehicles;
  // Whether it ends in a write that was never acknowledged.
  bool has_unfinished_tail = false;
};

// Of a store that no server has, before SQLite has opened it (which ends a log
// silently at the first damage). `known`: what its mark says.
absl::StatusOr<LogExamination> ExamineLog(
    const std::string& store, const std::optional<LogPosition>& known);

// "the log FILE is damaged: ...", with the vehicles.
std::string DamageText(const std::string& store,
                       const LogExamination& examination);

// Whether the log holds all that was flushed (write_ahead_log.h): before SQLite
// opens it, since it ends a log silently at the first damage. A damaged one is
// dropped if `drop_damaged_log`. `warn` may be empty.
absl::Status CheckLog(const std::string& store, bool drop_damaged_log,
                      const std::function<void(const std::string&)>& warn,
                      DurableMark* mark);

// The connection that writes. Makes the tables of a new store, brings an older
// one to this format, and copies what the log holds into the file and flushes
// it there: from then on it counts as durable, whatever became of the server
// before. `vfs` as in SqliteOptions.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenWriter(
    const std::string& store, const std::string& vfs, DurableMark* mark);

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
    const std::string& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_OPENING_H_
