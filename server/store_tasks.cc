#include "server/store_tasks.h"

#include <cstdint>
#include <cstdio>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_compaction.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"

namespace revisit::server {
namespace {

void Print(const StoreReport& report) {
  std::printf(
      "vehicles %lld\nposes %lld\nbatches %lld\nrevised batches %lld\n"
      "loop closures %lld\nrejected candidates %lld\n",
      static_cast<long long>(report.vehicles),
      static_cast<long long>(report.poses),
      static_cast<long long>(report.batches),
      static_cast<long long>(report.revised_batches),
      static_cast<long long>(report.loop_closures),
      static_cast<long long>(report.rejected_candidates));
}

ExitCode Fail(const absl::Status& status) {
  std::fprintf(stderr, "revisitd: %s\n", std::string(status.message()).c_str());
  return ExitCodeOf(status);
}

StoreUse UseOf(const std::string& file) {
  return StoreLock::IsHeld(file) ? StoreUse::kServed : StoreUse::kIdle;
}

ExitCode PrintFindings(const absl::StatusOr<StoreReport>& report) {
  if (!report.ok()) return Fail(report.status());
  Print(*report);
  if (report->problems.empty()) {
    std::printf("sound\n");
    return kExitOk;
  }
  for (const std::string& problem : report->problems) {
    std::printf("damage: %s\n", problem.c_str());
  }
  for (const std::string& vehicle : report->damaged_vehicles) {
    std::printf("damaged vehicle: %s\n", vehicle.c_str());
  }
  return kExitStoreDamaged;
}

ExitCode BackUp(const std::string& file, const std::string& destination,
                std::int64_t min_free_bytes) {
  BackupBounds bounds;
  // The server refuses writes below `min_free_bytes`, so a backup leaves it a
  // quarter more.
  bounds.min_free_bytes = min_free_bytes + min_free_bytes / 4;
  const absl::StatusOr<StoreReport> report =
      BackUpStore(file, UseOf(file), destination, bounds);
  if (!report.ok()) return Fail(report.status());
  Print(*report);
  std::printf("backup %s\n", destination.c_str());
  return kExitOk;
}

ExitCode Compact(const std::string& file) {
  const absl::StatusOr<CompactionReport> report = CompactStore(file);
  if (!report.ok()) return Fail(report.status());
  std::printf("bytes before %lld\nbytes after %lld\n",
              static_cast<long long>(report->bytes_before),
              static_cast<long long>(report->bytes_after));
  return kExitOk;
}

ExitCode Migrate(const std::string& url) {
  const absl::StatusOr<MigrationReport> report = MigrateDatabase(url);
  if (!report.ok()) return Fail(report.status());
  std::printf("version before %d\nversion after %d\n", report->version_before,
              report->version_after);
  return kExitOk;
}

ExitCode Misplaced(const std::string& message) {
  return Fail(absl::InvalidArgumentError(message));
}

ExitCode RunTaskOnDatabase(const ServerSettings& settings,
                           const StoreTask& task) {
  switch (task.kind) {
    case StoreTask::Kind::kBackup:
      return Misplaced(
          "backup is for a store in a file; a database is copied with its own "
          "tools while servers use it: pg_dump, or pg_basebackup with its log, "
          "which loses nothing");
    case StoreTask::Kind::kCompact:
      return Misplaced(
          "compact is for a store in a file; a database gives room back by "
          "itself (autovacuum), and all of it with VACUUM FULL");
    case StoreTask::Kind::kMigrate:
      return Migrate(settings.store);
    case StoreTask::Kind::kVerify:
      break;
  }
  return PrintFindings(CheckDatabase(settings.store));
}

ExitCode RunTaskOnFile(const ServerSettings& settings, const StoreTask& task) {
  if (task.kind == StoreTask::Kind::kMigrate) {
    return Misplaced(
        "migrate is for a store in a database, postgresql://...; a file is "
        "brought up to date when it is opened");
  }
  const absl::StatusOr<std::string> file = ExistingStoreFile(settings.store);
  if (!file.ok()) return Fail(file.status());
  switch (task.kind) {
    case StoreTask::Kind::kBackup:
      return BackUp(*file, task.other, settings.min_free_bytes);
    case StoreTask::Kind::kCompact:
      return Compact(*file);
    default:
      return PrintFindings(CheckStore(*file, UseOf(*file)));
  }
}

}  // namespace

ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task) {
  return IsSharedStore(settings.store) ? RunTaskOnDatabase(settings, task)
                                       : RunTaskOnFile(settings, task);
}

}  // namespace revisit::server
