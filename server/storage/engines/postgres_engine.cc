#include "server/storage/engines/postgres_engine.h"

#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "server/storage/engines/open_options.h"
#include "server/storage/engines/store_wait.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/postgres/postgres_intake.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/postgres/postgres_storage.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

// Beats within a lease: four may be late before others take the vehicles.
constexpr int kBeatsPerLease = 5;

// Whether others can reach this server by the address at which it listens.
bool NamesOneServer(const std::string& listen) {
  const std::string::size_type colon = listen.rfind(':');
  const std::string host = listen.substr(0, colon);
  return listen.substr(colon + 1) != "0" && host != "0.0.0.0" && host != "[::]";
}

PostgresOptions PostgresOptionsOf(const ServerSettings& settings,
                                  const Log* log) {
  PostgresOptions options;
  // The bytes of a page bound what a row may gather.
  options.max_joined_poses = kMostClaimedPoses;
  options.latency_target = LatencyTarget(settings);
  options.writer_connections = settings.store_connections;
  options.require_replicated = settings.require_replicated;
  options.ownership.address = settings.advertise_address.empty()
                                  ? settings.listen
                                  : settings.advertise_address;
  options.ownership.lease = Milliseconds(settings.lease_seconds);
  options.ownership.beat_period = options.ownership.lease / kBeatsPerLease;
  options.ownership.warn = WarnIn(log);
  return options;
}

StoreWait WaitFor(const StoreAccess& access) {
  return StoreWait(access.longest_wait, access.warn);
}

class DatabaseEngine : public StorageEngine {
 public:
  // Without the slashes it is a URL that was mistyped, not a path.
  bool Names(const std::string& store) const override {
    return absl::StartsWith(store, "postgresql:") ||
           absl::StartsWith(store, "postgres:");
  }

  absl::Status CheckSettings(const ServerSettings& settings) const override {
    if (!settings.advertise_address.empty() ||
        NamesOneServer(settings.listen)) {
      return absl::OkStatus();
    }
    return absl::InvalidArgumentError(
        absl::StrCat("listen is ", settings.listen,
                     ", by which no other server can name this one: give "
                     "advertise-address, HOST:PORT"));
  }

  // `on_failure` is never called: a database that fails may come back.
  absl::StatusOr<OpenedStore> Open(
      const ServerSettings& settings, const Log* log,
      std::function<void()> /*on_failure*/) const override {
    const PostgresOptions options = PostgresOptionsOf(settings, log);
    StoreWait wait(StoreWaitTime(settings), WarnIn(log));
    absl::StatusOr<std::unique_ptr<Storage>> storage = wait.Until(
        [&] { return OpenPostgresStorage(settings.store, options); });
    if (!storage.ok()) return storage.status();
    std::error_code error;
    const std::filesystem::path scratch =
        std::filesystem::temp_directory_path(error);
    return OpenedStore{*std::move(storage), WithoutSecrets(settings.store),
                       /*file=*/"", error ? "/tmp" : scratch.string(),
                       /*is_shared=*/true};
  }

  absl::StatusOr<std::unique_ptr<Storage>> OpenToCopy(
      const StoreAccess& access) const override {
    StoreWait wait = WaitFor(access);
    return wait.Until([&]() -> absl::StatusOr<std::unique_ptr<Storage>> {
      auto storage = OpenPostgresStorageToRead(access.store);
      if (!storage.ok()) return storage;
      const auto users = (*storage)->ListUsers();
      if (!users.ok()) return users.status();
      if (!users->empty()) {
        return absl::FailedPreconditionError(absl::StrCat(
            access.store, " is in use by the server ", users->front().address,
            ": end that first, so that nothing is written while it is "
            "copied"));
      }
      return storage;
    });
  }

  absl::StatusOr<std::unique_ptr<StoreIntake>> Fill(
      const StoreAccess& access) const override {
    return WaitFor(access).Until([&] { return FillDatabase(access.store); });
  }

  absl::StatusOr<StoreReport> Examine(
      const StoreAccess& access) const override {
    return WaitFor(access).Until([&] { return CheckDatabase(access.store); });
  }

  absl::StatusOr<StoreReport> BackUp(
      const StoreAccess& /*access*/,
      const std::string& /*destination*/) const override {
    return absl::InvalidArgumentError(
        "backup is for a store in a file; a database is copied with its own "
        "tools while servers use it: pg_dump, or pg_basebackup with its log, "
        "which loses nothing");
  }

  absl::StatusOr<std::string> Compact(
      const StoreAccess& /*access*/) const override {
    return absl::InvalidArgumentError(
        "compact is for a store in a file; a database gives room back by "
        "itself (autovacuum), and all of it with VACUUM FULL");
  }

  absl::StatusOr<std::string> Migrate(
      const StoreAccess& access) const override {
    const absl::StatusOr<MigrationReport> report =
        WaitFor(access).Until([&] { return MigrateDatabase(access.store); });
    if (!report.ok()) return report.status();
    return absl::StrCat("version before ", report->version_before,
                        "\nversion after ", report->version_after, "\n");
  }
};

}  // namespace

const StorageEngine& PostgresEngine() {
  static const DatabaseEngine engine;
  return engine;
}

}  // namespace revisit::server
