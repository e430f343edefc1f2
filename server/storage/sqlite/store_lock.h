// Keeps a second server from using a store.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_LOCK_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_LOCK_H_

#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {

// An exclusive lock on the file `<store>.lock`, which holds the process id of
// the owner and, below it, the state of the store as of its first and its last
// commit. The operating system releases the lock when the process ends in any
// way. The file stays: removing it would let two owners lock two files of one
// name. The store's own files are never locked here, because that would break
// SQLite's locks on them.
class StoreLock {
 public:
  // Makes the file if there is none, but only beside a database: so a lock
  // without a database shows that the database is missing. FAILED_PRECONDITION,
  // naming the process, if the store is in use.
  static absl::StatusOr<std::unique_ptr<StoreLock>> Acquire(
      const std::string& store_path);
  ~StoreLock();

  StoreLock(const StoreLock&) = delete;
  StoreLock& operator=(const StoreLock&) = delete;

  // Whether a process has the lock of a store. Writes nothing.
  static bool IsHeld(const std::string& store_path);
  // The state that a lock holds, if it holds one.
  static std::optional<StoreState> Read(const std::string& store_path);

  // Writes the state. If that fails, the file keeps an older one.
  void Write(const StoreState& state);

 private:
  explicit StoreLock(int file) : file_(file) {}

  const int file_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_LOCK_H_
