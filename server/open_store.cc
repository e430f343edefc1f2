#include "server/open_store.h"

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <system_error>
#include <utility>

#include "server/storage/postgres/postgres_storage.h"
#include "server/storage/record_check.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_files.h"
#include "server/store_wait.h"

namespace revisit::server {
namespace {

// Poses that a row of a file may gather from small batches of one vehicle: as
// many as one usual batch holds. In a database, the bytes of a page bound them.
constexpr std::size_t kRowPoses = 64;
// Beats within a lease: four may be late before others take the vehicles.
constexpr int kBeatsPerLease = 5;

std::chrono::microseconds LatencyTarget(const ServerSettings& settings) {
  return std::chrono::microseconds(
      static_cast<std::int64_t>(settings.ack_latency_target_ms * 1000.0));
}

std::function<void(const std::string&)> WarnIn(const Log* log) {
  return [log](const std::string& message) {
    log->Write(LogLevel::kWarning, "store", {{"message", message}});
  };
}

absl::StatusOr<OpenedStore> OpenFile(const ServerSettings& settings,
                                     const Log* log,
                                     std::function<void()> on_failure) {
  SqliteOptions options;
  options.max_joined_poses = kRowPoses;
  options.latency_target = LatencyTarget(settings);
  options.min_free_bytes = settings.min_free_bytes;
  options.max_checked_bytes = settings.max_checked_bytes;
  options.drop_damaged_log = settings.damaged_log == DamagedLog::kDrop;
  options.warn = WarnIn(log);
  options.on_failure =
      [log, on_failure = std::move(on_failure)](const absl::Status& status) {
        log->Write(LogLevel::kError, "store",
                   {{"message", std::string(status.message())}});
        on_failure();
      };
  const absl::StatusOr<std::string> file = StoreFileToServe(settings.store);
  if (!file.ok()) return file.status();
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenSqliteStorage(*file, options);
  if (!storage.ok()) return storage.status();
  return OpenedStore{*std::move(storage), *file, *file,
                     std::filesystem::absolute(*file).parent_path().string()};
}

absl::StatusOr<OpenedStore> OpenDatabase(const ServerSettings& settings,
                                         const Log* log) {
  PostgresOptions options;
  options.max_joined_poses = kMostClaimedPoses;
  options.latency_target = LatencyTarget(settings);
  options.writer_connections = settings.store_connections;
  options.require_replicated = settings.require_replicated;
  options.ownership.address = settings.advertise_address.empty()
                                  ? settings.listen
                                  : settings.advertise_address;
  options.ownership.lease = std::chrono::milliseconds(
      static_cast<std::int64_t>(settings.lease_seconds * 1000.0));
  options.ownership.beat_period = options.ownership.lease / kBeatsPerLease;
  options.ownership.warn = WarnIn(log);
  StoreWait wait(StoreWaitTime(settings), WarnIn(log));
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      wait.Until([&] { return OpenPostgresStorage(settings.store, options); });
  if (!storage.ok()) return storage.status();
  std::error_code error;
  const std::filesystem::path scratch =
      std::filesystem::temp_directory_path(error);
  return OpenedStore{*std::move(storage), WithoutSecrets(settings.store),
                     /*file=*/"", error ? "/tmp" : scratch.string()};
}

}  // namespace

absl::StatusOr<OpenedStore> OpenStoreToServe(const ServerSettings& settings,
                                             const Log* log,
                                             std::function<void()> on_failure) {
  return IsSharedStore(settings.store)
             ? OpenDatabase(settings, log)
             : OpenFile(settings, log, std::move(on_failure));
}

}  // namespace revisit::server
