// Connections that read a store.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_READER_POOL_H_
#define REVISIT_SERVER_STORAGE_SQLITE_READER_POOL_H_

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// Keeps a few connections open while nobody uses them. Thread-safe.
class ReaderPool {
 public:
  ReaderPool(std::string path, SqliteDatabase::Mode mode, std::string vfs)
      : path_(std::move(path)), mode_(mode), vfs_(std::move(vfs)) {}

  // Runs `read` on a connection of its own, all of it at one moment of the
  // store.
  absl::Status Read(const std::function<absl::Status(SqliteDatabase&)>& read);
  // Runs `read` as Read() does, and returns its answer.
  template <typename T>
  absl::StatusOr<T> Answer(
      const std::function<absl::StatusOr<T>(SqliteDatabase&)>& read) {
    absl::StatusOr<T> result = T();
    const absl::Status status = Read([&](SqliteDatabase& database) {
      result = read(database);
      return result.status();
    });
    if (!status.ok()) return status;
    return result;
  }

  // REQUIRES: nothing is read any more.
  void CloseAll();

 private:
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> Take();
  void GiveBack(std::unique_ptr<SqliteDatabase> reader);

  const std::string path_;
  const SqliteDatabase::Mode mode_;
  const std::string vfs_;

  Mutex mutex_;
  std::vector<std::unique_ptr<SqliteDatabase>> idle_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_READER_POOL_H_
