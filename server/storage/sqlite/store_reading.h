// Opening a store that somebody else may write: beneath store_opening.h, which
// opens it to write. Errors are the same.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_READING_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_READING_H_

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// Checks that the database can be read at all.
absl::Status CheckReadable(SqliteDatabase& database, const std::string& path);

// Opens a store of this format to read it whole (store_check.h,
// store_backup.h), also while a server has it open.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path, SqliteDatabase::Mode mode);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_READING_H_
