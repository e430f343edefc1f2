#include "server/storage/engines/store_tasks.h"

#include <cstdio>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/engines/engine.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

void Print(const StoreReport& report) {
  std::printf(
      "vehicles %lld\nposes %lld\nbatches %lld\nrevised batches %lld\n"
      "loop closures %lld\nrejected candidates %lld\ndeletions %lld\n"
      "checks %lld\nsnapshots %lld\ngroups %lld\nmembers of groups %lld\n"
      "loop closures of groups %lld\n",
      static_cast<long long>(report.vehicles),
      static_cast<long long>(report.poses),
      static_cast<long long>(report.batches),
      static_cast<long long>(report.revised_batches),
      static_cast<long long>(report.loop_closures),
      static_cast<long long>(report.rejected_candidates),
      static_cast<long long>(report.deleted_pairs),
      static_cast<long long>(report.checks),
      static_cast<long long>(report.snapshots),
      static_cast<long long>(report.groups),
      static_cast<long long>(report.members),
      static_cast<long long>(report.links));
}

void Complain(const std::string& message) {
  std::fprintf(stderr, "revisitd: %s\n", message.c_str());
}

ExitCode Fail(const absl::Status& status) {
  Complain(std::string(status.message()));
  return ExitCodeOf(status);
}

ExitCode PrintText(const absl::StatusOr<std::string>& findings) {
  if (!findings.ok()) return Fail(findings.status());
  std::fputs(findings->c_str(), stdout);
  return kExitOk;
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

ExitCode BackUp(const StoreAccess& store, const std::string& destination) {
  const absl::StatusOr<StoreReport> report =
      EngineOf(store.store).BackUp(store, destination);
  if (!report.ok()) return Fail(report.status());
  Print(*report);
  std::printf("backup %s\n", destination.c_str());
  return kExitOk;
}

// The store is free again when this returns.
absl::StatusOr<StoreReport> CopyInto(const StoreAccess& to, Storage& source) {
  const auto intake = EngineOf(to.store).Fill(to);
  if (!intake.ok()) return intake.status();
  return CopyStore(source, intake->get());
}

ExitCode Import(const StoreAccess& from, const StoreAccess& to) {
  const auto source = EngineOf(from.store).OpenToCopy(from);
  if (!source.ok()) return Fail(source.status());
  const absl::StatusOr<StoreReport> copied = CopyInto(to, **source);
  if (!copied.ok()) return Fail(copied.status());
  const absl::StatusOr<StoreReport> found = EngineOf(to.store).Examine(to);
  if (found.ok() && found->problems.empty() && !HoldTheSame(*copied, *found)) {
    return Fail(absl::DataLossError(
        "the imported store does not hold what was copied: do not use it"));
  }
  return PrintFindings(found);
}

}  // namespace

ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task) {
  const StoreAccess store = {settings.store, StoreWaitTime(settings),
                             settings.min_free_bytes, Complain};
  const StorageEngine& engine = EngineOf(settings.store);
  switch (task.kind) {
    case StoreTask::Kind::kBackup:
      return BackUp(store, task.other);
    case StoreTask::Kind::kCompact:
      return PrintText(engine.Compact(store));
    case StoreTask::Kind::kMigrate:
      return PrintText(engine.Migrate(store));
    case StoreTask::Kind::kImport: {
      StoreAccess source = store;
      source.store = task.other;
      return Import(source, store);
    }
    case StoreTask::Kind::kVerify:
      break;
  }
  return PrintFindings(engine.Examine(store));
}

}  // namespace revisit::server
