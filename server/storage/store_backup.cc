#include "server/storage/store_backup.h"

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <system_error>

#include "server/status.h"
#include "server/storage/durable_mark.h"
#include "server/storage/store_files.h"
#include "server/storage/store_opening.h"

namespace revisit::server {
namespace {

void RemoveCopy(const std::string& path) {
  std::error_code ignored;
  for (const char* suffix : {"", "-journal", "-wal", "-shm"}) {
    std::filesystem::remove(path + suffix, ignored);
  }
}

absl::Status Copy(const std::string& path, const std::string& copy) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> source =
      OpenDatabaseToRead(path);
  if (!source.ok()) return source.status();
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> destination =
      SqliteDatabase::Open(copy, SqliteDatabase::Mode::kReadWrite, "");
  if (!destination.ok()) return destination.status();
  const absl::Status copied = (*source)->CopyTo(destination->get());
  if (!copied.ok()) return copied;
  // One file, without a log beside it.
  return (*destination)->Execute("PRAGMA journal_mode = DELETE");
}

absl::StatusOr<StoreReport> CopyAndCheck(const std::string& path, StoreUse use,
                                         const std::string& copy) {
  // A log is read up to its first damage: the copy would be whole, and lack
  // what was acknowledged since.
  if (use == StoreUse::kIdle) {
    const absl::StatusOr<LogExamination> log =
        ExamineLog(path, DurableMark::Read(path));
    if (!log.ok()) return log.status();
    if (!log->damage.empty()) {
      return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT",
                   DamageText(path, *log));
    }
  }
  const absl::Status copied = Copy(path, copy);
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
                                        const std::string& destination) {
  std::error_code error;
  if (std::filesystem::exists(destination, error)) {
    return absl::FailedPreconditionError(
        destination + " is there already; a backup replaces nothing");
  }
  const std::string copy = destination + ".partial";
  RemoveCopy(copy);
  absl::StatusOr<StoreReport> report = CopyAndCheck(path, use, copy);
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
