// Opens the store that the settings name, wherever it is.
#ifndef REVISIT_SERVER_OPEN_STORE_H_
#define REVISIT_SERVER_OPEN_STORE_H_

#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/settings/settings.h"
#include "server/storage/storage.h"

namespace revisit::server {

struct OpenedStore {
  std::unique_ptr<Storage> storage;
  // For people: the file, or the database without its password.
  std::string name;
  // The file; empty if the store is a database.
  std::string file;
  // Where files may be made that no longer matter once the server ends.
  std::string scratch_directory;
};

// `on_failure` is called, once and on any thread, when the store takes no write
// any more until a new process has opened it. The log outlives the storage. A
// database that cannot be opened at the moment is awaited for as long as
// `store_wait_seconds` says.
// Errors are those of OpenSqliteStorage() or OpenPostgresStorage().
absl::StatusOr<OpenedStore> OpenStoreToServe(const ServerSettings& settings,
                                             const Log* log,
                                             std::function<void()> on_failure);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_OPEN_STORE_H_
