// The steps of making and opening a store, after store_examination.h: what
// sqlite_storage.h takes in which order.
//
// Errors, besides those of the device: FAILED_PRECONDITION for a file that is
// no store, or one of a newer format; DATA_LOSS (STORE_CORRUPT) for damage. The
// messages are for operators.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {

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

// Opens a connection that reads, and so keeps the log and its index open.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs);

// Checks that the structure of a file hides no row, unless the file is larger
// than the bound; the message names the vehicles with hidden rows.
absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       std::int64_t max_checked_bytes);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_OPENING_H_
