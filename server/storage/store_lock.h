// Keeps a second server off a store.
#ifndef REVISIT_SERVER_STORAGE_STORE_LOCK_H_
#define REVISIT_SERVER_STORAGE_STORE_LOCK_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

// An exclusive lock on the file `<store>.lock`, which holds the process id of
// the owner. The operating system lets go of it when the process ends in any
// way. The file stays: removing it would let two owners lock two files of one
// name. The store's own files are never locked here, since that would break
// SQLite's locks on them.
class StoreLock {
 public:
  // FAILED_PRECONDITION, naming the process, if the store is in use.
  static absl::StatusOr<std::unique_ptr<StoreLock>> Acquire(
      const std::string& store_path);
  ~StoreLock();

  StoreLock(const StoreLock&) = delete;
  StoreLock& operator=(const StoreLock&) = delete;

 private:
  explicit StoreLock(int file) : file_(file) {}

  const int file_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_LOCK_H_
