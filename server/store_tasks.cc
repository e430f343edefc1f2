#include "server/store_tasks.h"

#include <cstdint>
#include <cstdio>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
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
      "loop closures %lld\nrejected candidates %lld\nsnapshots %lld\n",
      static_cast<long long>(report.vehicles),
      static_cast<long long>(report.poses),
      static_cast<long long>(report.batches),
      static_cast<long long>(report.revised_batches),
      static_cast<long long>(report.loop_closures),
      static_cast<long long>(report.rejected_candidates),
      static_cast<long long>(report.snapshots));
}

ExitCode Fail(const absl::Status& status) {
  std::fprintf(stderr, "revisitd: %s\n", std::string(status.message()).c_str());
  return ExitCodeOf(status);
}

StoreUse UseOf(const std::string& file) {
  return StoreLock::IsHeld(file) ? StoreUse::kServed : StoreUse::kIdle;
}

ExitCode Verify(const std::string& file) {
  const absl::StatusOr<StoreReport> report = CheckStore(file, UseOf(file));
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

}  // namespace

ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task) {
  const absl::StatusOr<std::string> file = ExistingStoreFile(settings.store);
  if (!file.ok()) return Fail(file.status());
  switch (task.kind) {
    case StoreTask::Kind::kBackup:
      return BackUp(*file, task.destination, settings.min_free_bytes);
    case StoreTask::Kind::kCompact:
      return Compact(*file);
    case StoreTask::Kind::kVerify:
      break;
  }
  return Verify(*file);
}

}  // namespace revisit::server
