#include "server/storage/sqlite/store_compaction.h"

#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <system_error>

#include "server/base/status.h"
#include "server/storage/sqlite/freed_room.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_reading.h"
#include "server/storage/sqlite/store_state.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

void Remove(const std::string& copy) {
  std::error_code ignored;
  for (const char* suffix : {"", "-journal"}) {
    std::filesystem::remove(copy + suffix, ignored);
  }
}

std::string SqlLiteral(const std::string& text) {
  std::string quoted = "'";
  for (const char c : text) {
    quoted += c;
    if (c == '\'') quoted += c;
  }
  return quoted + "'";
}

// Writes the copy. REQUIRES: nobody has the store open, and it has no log.
absl::Status Vacuum(const std::string& path, const std::string& copy,
                    StoreState* state) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> source =
      OpenDatabaseToRead(path, SqliteDatabase::Mode::kFileOnly);
  if (!source.ok()) return source.status();
  const absl::StatusOr<StoreState> before = ReadState(**source);
  if (!before.ok()) return before.status();
  absl::Status status = MakePrivateFile(copy);
  if (!status.ok()) return status;
  status = SetShrinking(**source);
  if (!status.ok()) return status;
  status = (*source)->Execute(("VACUUM INTO " + SqlLiteral(copy)).c_str());
  if (!status.ok()) return status;
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> made =
      SqliteDatabase::Open(copy, SqliteDatabase::Mode::kReadWrite, "");
  if (!made.ok()) return made.status();
  // A new run, because a log of the old file describes other pages.
  *state = NextState(*before, RandomRun(), /*is_closed=*/true);
  return WriteState(**made, *state);
}

// Gives the copy the rights of the file that it replaces.
absl::Status TakeRightsOf(const std::string& path, const std::string& copy) {
  struct stat status;
  if (stat(path.c_str(), &status) != 0 ||
      chmod(copy.c_str(), status.st_mode & 07777) != 0 ||
      ((status.st_uid != geteuid() || status.st_gid != getegid()) &&
       chown(copy.c_str(), status.st_uid, status.st_gid) != 0)) {
    return absl::ErrnoToStatus(errno, "cannot set the rights of " + copy);
  }
  return absl::OkStatus();
}

absl::StatusOr<StoreReport> MustBeSound(const std::string& path) {
  absl::StatusOr<StoreReport> report = CheckStore(path, StoreUse::kIdle);
  if (!report.ok() || report->problems.empty()) return report;
  return Corrupt(
      "the store " + path + " is damaged: " + report->problems.front(), {});
}

absl::Status Replace(const std::string& path, const std::string& copy,
                     StoreLock* lock) {
  StoreState state;
  absl::Status status = Vacuum(path, copy, &state);
  if (!status.ok()) return status;
  const absl::StatusOr<StoreReport> before = MustBeSound(path);
  if (!before.ok()) return before.status();
  const absl::StatusOr<StoreReport> after = MustBeSound(copy);
  if (!after.ok()) return after.status();
  if (!HoldTheSame(*before, *after)) {
    return Corrupt("the compacted copy of " + path + " lacks rows", {});
  }
  status = TakeRightsOf(path, copy);
  if (status.ok()) status = FlushFile(copy);
  if (!status.ok()) return status;
  if (std::rename(copy.c_str(), path.c_str()) != 0) {
    return absl::ErrnoToStatus(errno, "cannot replace " + path);
  }
  lock->Write(state);
  return FlushFile(std::filesystem::path(path).parent_path().string());
}

}  // namespace

absl::StatusOr<CompactionReport> CompactStore(const std::string& name) {
  std::error_code error;
  const std::string path =
      std::filesystem::weakly_canonical(name, error).string();
  const absl::Status is_there = CheckDatabaseIsThere(path);
  if (!is_there.ok()) return is_there;
  CompactionReport report;
  report.bytes_before = BytesOf(path);
  // Opening brings the store to this format, and copies the log into it.
  absl::Status status = OpenSqliteStorage(path).status();
  if (!status.ok()) return status;
  const absl::StatusOr<std::unique_ptr<StoreLock>> lock =
      StoreLock::Acquire(path);
  if (!lock.ok()) return lock.status();
  const absl::StatusOr<StoreExamination> files = ExamineStore(path);
  if (!files.ok()) return files.status();
  if (!files->damage.empty()) return DamageOf(*files);
  if (!files->has_no_log) {
    return absl::FailedPreconditionError(
        "the store " + path +
        " is being read by another process, such as a backup: wait for it");
  }
  const std::string copy = path + ".compact";
  Remove(copy);
  status = Replace(path, copy, lock->get());
  if (!status.ok()) {
    Remove(copy);
    return status;
  }
  report.bytes_after = BytesOf(path);
  return report;
}

}  // namespace revisit::server
