// Copies a store while a server is at work on it.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_BACKUP_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_BACKUP_H_

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/sqlite/store_check.h"

namespace revisit::server {

// How much a backup may cost the server beside it, which cannot write over its
// log while the copy is made.
struct BackupBounds {
  std::int64_t max_log_growth = std::int64_t{1} << 30;
  // Bytes that must stay free on the file system of the store.
  std::int64_t min_free_bytes = 0;
};

// Makes one file that is a store by itself, as of one moment: every write that
// was acknowledged before the call is in it. The copy is read whole and flushed
// before it gets its name, so a file of that name is a good one. The store is
// not changed, and writes go on meanwhile; the log grows until the copy is
// done.
//
// FAILED_PRECONDITION if there is a file of that name, or if the store is not
// of this format; DATA_LOSS if the store is damaged; UNAVAILABLE beyond a
// bound. After an error there is no copy. `use` says whether a server may be
// writing to the store.
absl::StatusOr<StoreReport> BackUpStore(const std::string& path, StoreUse use,
                                        const std::string& destination,
                                        const BackupBounds& bounds = {});

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_BACKUP_H_
