#include "server/store_tasks.h"

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/postgres/postgres_intake.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_compaction.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_intake.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/storage.h"
#include "server/storage/store_copy.h"
#include "server/storage/store_note.h"
#include "server/store_wait.h"

namespace revisit::server {
namespace {

void Print(const StoreReport& report) {
  std::printf(
      "vehicles %lld\nposes %lld\nbatches %lld\nrevised batches %lld\n"
      "loop closures %lld\nrejected candidates %lld\nsnapshots %lld\n",
      static_cast<long long>(report.vehicles),
      static_cast<long long>(report.poses),
      static_cast<long long>(report.batches),
      static_cast<long long>(report.revised_batches),
      static_cast<long long>(report.loop_closures),
      static_cast<long long>(report.rejected_candidates),
      static_cast<long long>(report.snapshots));
}

// The time begins anew for each store of a task.
StoreWait WaitFor(const ServerSettings& settings) {
  return StoreWait(StoreWaitTime(settings), [](const std::string& message) {
    std::fprintf(stderr, "revisitd: %s\n", message.c_str());
  });
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
  if (report->problems.empty() && report->damaged_snapshots.empty()) {
    std::printf("sound\n");
    return kExitOk;
  }
  for (const std::string& problem : report->problems) {
    std::printf("damage: %s\n", problem.c_str());
  }
  for (const std::string& vehicle : report->damaged_vehicles) {
    std::printf("damaged vehicle: %s\n", vehicle.c_str());
  }
  for (const std::string& snapshot : report->damaged_snapshots) {
    std::printf("damaged snapshot, which the server makes again: %s\n",
                snapshot.c_str());
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
  const std::string note = BackupNoteOf(file);
  if (!WriteNote(note, {kBackup, std::chrono::system_clock::now()})) {
    std::fprintf(stderr,
                 "revisitd: cannot write %s: no metric will say that this "
                 "backup was made\n",
                 note.c_str());
  }
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

ExitCode Migrate(const std::string& url, StoreWait wait) {
  const absl::StatusOr<MigrationReport> report =
      wait.Until([&] { return MigrateDatabase(url); });
  if (!report.ok()) return Fail(report.status());
  std::printf("version before %d\nversion after %d\n", report->version_before,
              report->version_after);
  return kExitOk;
}

absl::StatusOr<std::unique_ptr<Storage>> OpenSource(const std::string& store,
                                                    StoreWait wait) {
  const auto in_use = [&](const std::string& by) {
    return absl::FailedPreconditionError(store + " is in use by " + by +
                                         ": end that first, so that nothing "
                                         "is written while it is copied");
  };
  if (IsSharedStore(store)) {
    return wait.Until([&]() -> absl::StatusOr<std::unique_ptr<Storage>> {
      auto storage = OpenPostgresStorageToRead(store);
      if (!storage.ok()) return storage;
      const auto users = (*storage)->ListUsers();
      if (!users.ok()) return users.status();
      if (!users->empty()) {
        return in_use("the server " + users->front().address);
      }
      return storage;
    });
  }
  const absl::StatusOr<std::string> file = ExistingStoreFile(store);
  if (!file.ok()) return file.status();
  // Brings it to this format, and finds out whether somebody else has it.
  absl::Status status = OpenSqliteStorage(*file).status();
  if (!status.ok()) return status;
  return OpenSqliteStorageToRead(*file, SqliteDatabase::Mode::kReadOnly);
}

absl::StatusOr<StoreReport> CopyInto(const std::string& store, Storage& source,
                                     StoreWait wait) {
  if (IsSharedStore(store)) {
    const auto intake = wait.Until([&] { return FillDatabase(store); });
    if (!intake.ok()) return intake.status();
    return CopyStore(source, intake->get());
  }
  const absl::StatusOr<std::string> file = StoreFileToServe(store);
  if (!file.ok()) return file.status();
  const auto intake = FillFile(*file);
  if (!intake.ok()) return intake.status();
  return CopyStore(source, intake->get());
}

absl::StatusOr<StoreReport> CheckAny(const std::string& store, StoreWait wait) {
  if (IsSharedStore(store)) {
    return wait.Until([&] { return CheckDatabase(store); });
  }
  const absl::StatusOr<std::string> file = ExistingStoreFile(store);
  if (!file.ok()) return file.status();
  return CheckStore(*file, StoreUse::kIdle);
}

ExitCode Import(const ServerSettings& settings, const std::string& from) {
  const std::string& destination = settings.store;
  const auto source = OpenSource(from, WaitFor(settings));
  if (!source.ok()) return Fail(source.status());
  const absl::StatusOr<StoreReport> copied =
      CopyInto(destination, **source, WaitFor(settings));
  if (!copied.ok()) return Fail(copied.status());
  const absl::StatusOr<StoreReport> found =
      CheckAny(destination, WaitFor(settings));
  if (found.ok() && found->problems.empty() && !HoldTheSame(*copied, *found)) {
    return Fail(absl::DataLossError(
        "the imported store does not hold what was copied: do not use it"));
  }
  return PrintFindings(found);
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
      return Migrate(settings.store, WaitFor(settings));
    case StoreTask::Kind::kImport:
      return Import(settings, task.other);
    case StoreTask::Kind::kVerify:
      break;
  }
  return PrintFindings(CheckAny(settings.store, WaitFor(settings)));
}

ExitCode RunTaskOnFile(const ServerSettings& settings, const StoreTask& task) {
  if (task.kind == StoreTask::Kind::kMigrate) {
    return Misplaced(
        "migrate is for a store in a database, postgresql://...; a file is "
        "brought up to date when it is opened");
  }
  if (task.kind == StoreTask::Kind::kImport) {
    return Import(settings, task.other);
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
