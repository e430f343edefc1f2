#include "server/storage/sqlite/store_opening.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <system_error>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_format.h"
#include "server/storage/sqlite/store_reading.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// Makes other servers wait that make a store in the same directory. On a file
// system without such locks nobody waits.
class DirectoryLock {
 public:
  explicit DirectoryLock(const std::string& directory)
      : file_(open(directory.empty() ? "." : directory.c_str(),
                   O_RDONLY | O_DIRECTORY | O_CLOEXEC)) {
    if (file_ >= 0) static_cast<void>(flock(file_, LOCK_EX));
  }
  ~DirectoryLock() {
    if (file_ >= 0) close(file_);
  }

  DirectoryLock(const DirectoryLock&) = delete;
  DirectoryLock& operator=(const DirectoryLock&) = delete;

 private:
  const int file_;
};

}  // namespace

absl::Status MakeStore(const std::string& store, const std::string& vfs,
                       std::uint64_t run) {
  const std::string directory =
      std::filesystem::path(store).parent_path().string();
  const DirectoryLock lock(directory);
  std::error_code error;
  if (std::filesystem::exists(store, error)) return absl::OkStatus();
  // The file has another name until it is whole: a kill leaves no half a store.
  const std::string made = store + ".new";
  for (const char* suffix : {"", "-journal", "-wal", "-shm"}) {
    std::filesystem::remove(made + suffix, error);
  }
  absl::Status status = MakePrivateFile(made);
  if (!status.ok()) return status;
  {
    const absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
        SqliteDatabase::Open(made, SqliteDatabase::Mode::kReadWrite, vfs);
    if (!database.ok()) return database.status();
    status = MakeTables(**database, run);
    if (status.ok()) {
      status = (*database)->Execute("PRAGMA journal_mode = WAL");
    }
  }
  if (status.ok()) status = FlushFile(made);
  if (!status.ok()) return status;
  if (std::rename(made.c_str(), store.c_str()) != 0) {
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "cannot name " + absl::ErrnoToStatus(errno, store).ToString());
  }
  return FlushFile(directory);
}

absl::StatusOr<OpenedWriter> OpenWriter(const std::string& path,
                                        const std::string& vfs,
                                        std::uint64_t run, DurableMark* mark,
                                        bool copies_log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, SqliteDatabase::Mode::kReadWrite, vfs);
  if (!database.ok()) return database.status();
  // Otherwise a failure below would remove a log that the mark names.
  (*database)->KeepLogOnClose(true);
  // Checked before anything is changed in a file that may not be a store.
  absl::Status status = CheckReadable(**database, path);
  if (!status.ok()) return status;
  status = BringToStoreFormat(**database, path, run);
  if (!status.ok()) return status;
  status = CheckSchema(**database, path);
  if (!status.ok()) return status;
  {
    SqliteStatement wal = (*database)->Prepare("PRAGMA journal_mode = WAL");
    const absl::StatusOr<bool> row = wal.Step();
    if (!row.ok()) return row.status();
    if (!*row || wal.Bytes(0) != "wal") {
      return absl::FailedPreconditionError(
          "the file system of " + path +
          " does not support SQLite's write-ahead log");
    }
  }
  status = (*database)->Execute(
      "PRAGMA synchronous = FULL;"
      "PRAGMA cell_size_check = ON;"
      "PRAGMA trusted_schema = OFF;"
      "PRAGMA temp_store = MEMORY;"
      "PRAGMA journal_size_limit = 67108864");
  if (!status.ok()) return status;
  const absl::StatusOr<StoreState> state = ReadState(**database);
  if (!state.ok()) return state.status();
  const absl::StatusOr<bool> copied =
      copies_log ? (*database)->CopyLog() : false;
  if (!copied.ok() && !IsStorageFull(copied.status())) return copied.status();
  OpenedWriter opened;
  opened.state = *state;
  opened.is_copied = copied.ok() && *copied;
  if (opened.is_copied) {
    // Everything is in the database, so the log may be emptied, which removes
    // what a failed transaction left in it.
    status = mark->Flush(*state);
    if (status.ok()) status = (*database)->EmptyLog();
    if (!status.ok() && !IsStorageFull(status)) return status;
  }
  opened.database = *std::move(database);
  return opened;
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kReadOnly, vfs);
  if (!anchor.ok()) return anchor;
  const absl::Status readable = CheckReadable(**anchor, store);
  if (!readable.ok()) return readable;
  return anchor;
}

absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       std::int64_t max_checked_bytes) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(store, error);
  if (error || bytes > static_cast<std::uintmax_t>(max_checked_bytes)) {
    return absl::OkStatus();
  }
  const absl::StatusOr<std::vector<std::string>> problems =
      FindStructuralDamage(database, StoreUse::kIdle, store);
  if (!problems.ok() && !IsCorruption(problems.status())) {
    return problems.status();
  }
  if (problems.ok() && problems->empty()) return absl::OkStatus();
  const std::string what = problems.ok()
                               ? problems->front()
                               : std::string(problems.status().message());
  // Read as served, because this process has it open; the files beside it were
  // examined before.
  const absl::StatusOr<StoreReport> report =
      CheckStore(store, StoreUse::kServed);
  const std::string names = report.ok() && !report->damaged_vehicles.empty()
                                ? Listed(report->damaged_vehicles)
                                : "cannot be told";
  return Corrupt("the store " + store + " is damaged: " + what +
                     "; vehicles that cannot be read whole: " + names,
                 {{"vehicles", names}});
}

}  // namespace revisit::server
