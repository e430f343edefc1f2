#include "server/storage/sqlite/store_reading.h"

#include <fstream>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/store_format.h"

namespace revisit::server {
namespace {

// Whether the file begins as every SQLite file does.
bool BeginsAsDatabase(const std::string& path) {
  const std::string expected("SQLite format 3\0", 16);
  std::string found(expected.size(), ' ');
  std::ifstream file(path, std::ios::binary);
  file.read(found.data(), static_cast<std::streamsize>(found.size()));
  return file.gcount() == static_cast<std::streamsize>(found.size()) &&
         found == expected;
}

}  // namespace

absl::Status CheckReadable(SqliteDatabase& database, const std::string& path) {
  const absl::Status status =
      database.QueryInteger("PRAGMA schema_version").status();
  if (!IsCorruption(status)) return status;
  const std::string what(status.message());
  if (!BeginsAsDatabase(path)) {
    return absl::FailedPreconditionError(path +
                                         " is not a store of revisit: " + what);
  }
  return Corrupt("the store " + path + " is damaged: " + what, {});
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path, SqliteDatabase::Mode mode) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, mode, "");
  if (!database.ok()) return database;
  const absl::Status readable = CheckReadable(**database, path);
  if (!readable.ok()) return readable;
  const absl::StatusOr<FileFormat> format = ReadFormat(**database);
  if (!format.ok()) return format.status();
  const absl::Status known = CheckKnownFormat(path, *format);
  if (!known.ok()) return known;
  if (format->version != kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(format->version) +
        ": a server that is started on it brings it to format " +
        std::to_string(kStoreFormat));
  }
  const absl::Status schema = CheckSchema(**database, path);
  if (!schema.ok()) return schema;
  return database;
}

}  // namespace revisit::server
