#include "server/storage/engines/sqlite_engine.h"

#include <cstddef>
#include <filesystem>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/storage/engines/open_options.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_compaction.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_intake.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/store_note.h"

namespace revisit::server {
namespace {

// Poses that a row of a file may gather from batches of one vehicle that wait
// together: pages are full of rows of several pages, and a third empty behind
// one usual batch. Who reads one pose reads its row, so they are not more.
constexpr std::size_t kRowPoses = 512;

StoreUse UseOf(const std::string& file) {
  return StoreLock::IsHeld(file) ? StoreUse::kServed : StoreUse::kIdle;
}

SqliteOptions SqliteOptionsOf(const ServerSettings& settings, const Log* log,
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
  return options;
}

class FileEngine : public StorageEngine {
 public:
  // A path is any text.
  bool Names(const std::string& /*store*/) const override { return true; }

  // A store in a file is shared with nobody.
  absl::Status CheckSettings(const ServerSettings& settings) const override {
    for (const auto& [key, is_set] :
         {std::pair("require-replicated", settings.require_replicated),
          std::pair("advertise-address",
                    !settings.advertise_address.empty())}) {
      if (!is_set) continue;
      return absl::InvalidArgumentError(absl::StrCat(
          key,
          " needs a store that servers share, postgresql://...; store is \"",
          settings.store, "\""));
    }
    return absl::OkStatus();
  }

  absl::StatusOr<OpenedStore> Open(
      const ServerSettings& settings, const Log* log,
      std::function<void()> on_failure) const override {
    const absl::StatusOr<std::string> file = StoreFileToServe(settings.store);
    if (!file.ok()) return file.status();
    absl::StatusOr<std::unique_ptr<Storage>> storage = OpenSqliteStorage(
        *file, SqliteOptionsOf(settings, log, std::move(on_failure)));
    if (!storage.ok()) return storage.status();
    return OpenedStore{*std::move(storage), *file, *file,
                       std::filesystem::absolute(*file).parent_path().string(),
                       /*is_shared=*/false};
  }

  absl::StatusOr<std::unique_ptr<Storage>> OpenToCopy(
      const StoreAccess& access) const override {
    const absl::StatusOr<std::string> file = ExistingStoreFile(access.store);
    if (!file.ok()) return file.status();
    // Brings it to this format, and finds out whether somebody else has it.
    absl::Status status = OpenSqliteStorage(*file).status();
    if (!status.ok()) return status;
    return OpenSqliteStorageToRead(*file, SqliteDatabase::Mode::kReadOnly);
  }

  absl::StatusOr<std::unique_ptr<StoreIntake>> Fill(
      const StoreAccess& access) const override {
    const absl::StatusOr<std::string> file = StoreFileToServe(access.store);
    if (!file.ok()) return file.status();
    return FillFile(*file);
  }

  absl::StatusOr<StoreReport> Examine(
      const StoreAccess& access) const override {
    const absl::StatusOr<std::string> file = ExistingStoreFile(access.store);
    if (!file.ok()) return file.status();
    return CheckStore(*file, UseOf(*file));
  }

  absl::StatusOr<StoreReport> BackUp(
      const StoreAccess& access,
      const std::string& destination) const override {
    const absl::StatusOr<std::string> file = ExistingStoreFile(access.store);
    if (!file.ok()) return file.status();
    BackupBounds bounds;
    // The server refuses writes below `min_free_bytes`, so a backup leaves it a
    // quarter more.
    bounds.min_free_bytes = access.min_free_bytes + access.min_free_bytes / 4;
    absl::StatusOr<StoreReport> report =
        BackUpStore(*file, UseOf(*file), destination, bounds);
    if (!report.ok()) return report;
    const std::string note = BackupNoteOf(*file);
    if (!WriteNote(note, {kBackup, std::chrono::system_clock::now()})) {
      access.warn(
          absl::StrCat("cannot write ", note,
                       ": no metric will say that this backup was made"));
    }
    return report;
  }

  absl::StatusOr<std::string> Compact(
      const StoreAccess& access) const override {
    const absl::StatusOr<std::string> file = ExistingStoreFile(access.store);
    if (!file.ok()) return file.status();
    const absl::StatusOr<CompactionReport> report = CompactStore(*file);
    if (!report.ok()) return report.status();
    return absl::StrCat("bytes before ", report->bytes_before, "\nbytes after ",
                        report->bytes_after, "\n");
  }

  absl::StatusOr<std::string> Migrate(
      const StoreAccess& /*access*/) const override {
    return absl::InvalidArgumentError(
        "migrate is for a store in a database, postgresql://...; a file is "
        "brought up to date when it is opened");
  }
};

}  // namespace

const StorageEngine& SqliteEngine() {
  static const FileEngine engine;
  return engine;
}

}  // namespace revisit::server
