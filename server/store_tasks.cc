#include "server/store_tasks.h"

#include <cstdio>
#include <filesystem>
#include <string>
#include <system_error>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/store_backup.h"
#include "server/storage/store_check.h"
#include "server/storage/store_lock.h"

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

// Whether no server has the store. Only a store that has been served has a
// lock.
StoreUse UseOf(const std::string& file) {
  std::error_code error;
  if (!std::filesystem::exists(file + ".lock", error)) return StoreUse::kIdle;
  return StoreLock::Acquire(file).ok() ? StoreUse::kIdle : StoreUse::kServed;
}

ExitCode Verify(const std::string& file) {
  const absl::StatusOr<StoreReport> report = CheckStore(file, UseOf(file));
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

ExitCode BackUp(const std::string& file, const std::string& destination) {
  const absl::StatusOr<StoreReport> report =
      BackUpStore(file, UseOf(file), destination);
  if (!report.ok()) return Fail(report.status());
  Print(*report);
  std::printf("backup %s\n", destination.c_str());
  return kExitOk;
}

}  // namespace

ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task) {
  const absl::StatusOr<std::string> file = ExistingStoreFile(settings.store);
  if (!file.ok()) return Fail(file.status());
  return task.kind == StoreTask::Kind::kBackup ? BackUp(*file, task.destination)
                                               : Verify(*file);
}

}  // namespace revisit::server
