// The engines that keep a store, each with all that the server and its tasks do
// with a store of it. A new one is a folder of server/storage, a class here and
// a row in engines.cc.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_ENGINE_H_
#define REVISIT_SERVER_STORAGE_ENGINES_ENGINE_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/settings/settings.h"
#include "server/storage/storage.h"
#include "server/storage/store_copy.h"
#include "server/storage/store_report.h"

namespace revisit::server {

struct OpenedStore {
  std::unique_ptr<Storage> storage;
  // For people: the file, or the database without its password.
  std::string name;
  // The file; empty if the store is a database.
  std::string file;
  // Where files may be made that no longer matter once the server ends.
  std::string scratch_directory;
  // Whether other servers may write to the store too.
  bool is_shared = false;
};

// A store as a task comes to it.
struct StoreAccess {
  // The same as in ServerSettings.
  std::string store;
  // How long a store that cannot be opened at the moment is awaited, where that
  // may pass by itself. The time begins anew with each call.
  std::chrono::milliseconds longest_wait{0};
  // See ServerSettings.
  std::int64_t min_free_bytes = 0;
  // Called with what an operator should know.
  std::function<void(const std::string&)> warn;
};

// Thread-safe.
class StorageEngine {
 public:
  virtual ~StorageEngine() = default;

  // Whether this value of ServerSettings::store, or of a task, names a store of
  // this engine.
  virtual bool Names(const std::string& store) const = 0;

  // INVALID_ARGUMENT, with a message for people, if the other settings do not
  // go with a store of this engine.
  virtual absl::Status CheckSettings(const ServerSettings& settings) const = 0;

  // Opens the store that the settings name. `on_failure` is called, once and on
  // any thread, when the store takes no write any more until a new process has
  // opened it. The log outlives the storage.
  virtual absl::StatusOr<OpenedStore> Open(
      const ServerSettings& settings, const Log* log,
      std::function<void()> on_failure) const = 0;

  // ---- Tasks, each a process of its own. One that the engine has no use for
  // is INVALID_ARGUMENT, with a message that says what to do instead.

  // Opens a store that nobody uses, for reading: FAILED_PRECONDITION if
  // somebody does.
  virtual absl::StatusOr<std::unique_ptr<Storage>> OpenToCopy(
      const StoreAccess& access) const = 0;
  // An empty store, which is to be filled.
  virtual absl::StatusOr<std::unique_ptr<StoreIntake>> Fill(
      const StoreAccess& access) const = 0;
  // Reads all of a store; a server may be using it.
  virtual absl::StatusOr<StoreReport> Examine(
      const StoreAccess& access) const = 0;
  // Copies a store, which a server may be using, to a file, and notes that it
  // was copied.
  virtual absl::StatusOr<StoreReport> BackUp(
      const StoreAccess& access, const std::string& destination) const = 0;
  // Makes a store that nobody uses as small as its contents. Returns findings,
  // a line each.
  virtual absl::StatusOr<std::string> Compact(
      const StoreAccess& access) const = 0;
  // Brings the tables of a store to this version. Returns findings, a line
  // each.
  virtual absl::StatusOr<std::string> Migrate(
      const StoreAccess& access) const = 0;
};

// The engine of a store that is named so.
const StorageEngine& EngineOf(const std::string& store);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_ENGINE_H_
