// The format of a store's file: its tables, and what its head says of them.
// sqlite_storage.h says what the tables hold.
//
// Errors, besides those of the device: FAILED_PRECONDITION for a file that is
// no store, or one of a format that is not read; DATA_LOSS (STORE_CORRUPT) for
// damage. The messages are for operators.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_FORMAT_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_FORMAT_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// The program and the format that the head of an SQLite file names; both are 0
// in a new file.
struct FileFormat {
  std::int64_t application = 0;
  std::int64_t version = 0;
};

absl::StatusOr<FileFormat> ReadFormat(SqliteDatabase& database);

// OK if the file is a store of this format or of one before it.
absl::Status CheckKnownFormat(const std::string& path,
                              const FileFormat& format);

// Makes a new file a store of this format without vehicles, in one transaction.
// `run` is that of its first commit (store_state.h).
absl::Status MakeTables(SqliteDatabase& database, std::uint64_t run);

// Brings a store of a known format to this one, in one transaction.
absl::Status BringToStoreFormat(SqliteDatabase& database,
                                const std::string& path, std::uint64_t run);

// Compares the stored statements that made the tables with ours: SQLite goes by
// the names of tables alone, and damage to a statement would later look like a
// defect of the server.
absl::Status CheckSchema(SqliteDatabase& database, const std::string& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_FORMAT_H_
