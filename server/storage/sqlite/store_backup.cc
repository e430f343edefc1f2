#include "server/storage/sqlite/store_backup.h"

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <system_error>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_reading.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {
namespace {

void RemoveCopy(const std::string& path) {
  std::error_code ignored;
  for (const char* suffix : {"", "-journal", "-wal", "-shm"}) {
    std::filesystem::remove(path + suffix, ignored);
  }
}

absl::Status GiveWay(const std::string& why) {
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               "the backup gave way to the server, and nothing was kept of "
               "it: " +
                   why + "; copy to a faster disk, or while less is written");
}

// UNAVAILABLE if the log has grown beyond the bounds, for it cannot be written
// over while the copy is made, or if the disk runs short.
absl::Status CheckLog(const std::string& path, std::int64_t log_bytes_before,
                      const BackupBounds& bounds) {
  const std::int64_t grown = BytesOf(LogOf(path)) - log_bytes_before;
  if (grown > bounds.max_log_growth) {
    return GiveWay("the log " + LogOf(path) + " grew by " +
                   std::to_string(grown) + " bytes meanwhile, allowed are " +
                   std::to_string(bounds.max_log_growth));
  }
  const absl::StatusOr<std::int64_t> free =
      FreeBytes(std::filesystem::absolute(path).parent_path().string());
  if (free.ok() && *free < bounds.min_free_bytes) {
    return GiveWay("the file system of the store has " + std::to_string(*free) +
                   " bytes left, needed are " +
                   std::to_string(bounds.min_free_bytes));
  }
  return absl::OkStatus();
}

absl::Status Copy(const StoreToRead& store, const std::string& copy,
                  const BackupBounds& bounds) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> source =
      OpenDatabaseToRead(store.path, store.mode);
  if (!source.ok()) return source.status();
  const absl::Status made = MakePrivateFile(copy);
  if (!made.ok()) return made;
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> destination =
      SqliteDatabase::Open(copy, SqliteDatabase::Mode::kReadWrite, "");
  if (!destination.ok()) return destination.status();
  const std::int64_t log_bytes = BytesOf(LogOf(store.path));
  const absl::Status copied = (*source)->CopyTo(destination->get(), [&] {
    return store.use == StoreUse::kIdle
               ? absl::OkStatus()
               : CheckLog(store.path, log_bytes, bounds);
  });
  if (!copied.ok()) return copied;
  absl::StatusOr<StoreState> state = ReadState(**destination);
  if (!state.ok()) return state.status();
  state->is_closed = true;
  const absl::Status closed = WriteState(**destination, *state);
  if (!closed.ok()) return closed;
  // Makes it one file, without a log beside it.
  return (*destination)->Execute("PRAGMA journal_mode = DELETE");
}

absl::StatusOr<StoreReport> CopyAndCheck(const std::string& path, StoreUse use,
                                         const std::string& copy,
                                         const BackupBounds& bounds) {
  const absl::StatusOr<StoreToRead> store = LookAtStore(path, use);
  if (!store.ok()) return store.status();
  // SQLite reads a log up to its first damage: the copy would be sound, and
  // lack commits that were acknowledged since.
  if (!store->files.damage.empty()) return DamageOf(store->files);
  const absl::Status copied = Copy(*store, copy, bounds);
  if (HasChanged(*store)) {
    RemoveCopy(copy);
    return CopyAndCheck(path, StoreUse::kServed, copy, bounds);
  }
  if (!copied.ok()) return copied;
  absl::StatusOr<StoreReport> report = CheckStore(copy, StoreUse::kIdle);
  if (!report.ok()) return report;
  if (!report->problems.empty()) {
    return Error(
        absl::StatusCode::kDataLoss, "STORE_CORRUPT",
        "the store " + path + " is damaged: " + report->problems.front());
  }
  const absl::Status flushed = FlushFile(copy);
  if (!flushed.ok()) return flushed;
  return report;
}

}  // namespace

absl::StatusOr<StoreReport> BackUpStore(const std::string& path, StoreUse use,
                                        const std::string& destination,
                                        const BackupBounds& bounds) {
  std::error_code error;
  if (std::filesystem::exists(destination, error)) {
    return absl::FailedPreconditionError(
        destination + " is there already; a backup replaces nothing");
  }
  const std::string copy = destination + ".partial";
  RemoveCopy(copy);
  absl::StatusOr<StoreReport> report = CopyAndCheck(path, use, copy, bounds);
  if (report.ok() && std::rename(copy.c_str(), destination.c_str()) != 0) {
    report = absl::ErrnoToStatus(errno, "cannot name the copy " + destination);
  }
  if (!report.ok()) {
    RemoveCopy(copy);
    return report;
  }
  const std::filesystem::path directory =
      std::filesystem::absolute(destination, error).parent_path();
  const absl::Status named = FlushFile(directory.string());
  if (!named.ok()) return named;
  return report;
}

}  // namespace revisit::server
