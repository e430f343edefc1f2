// Makes the file of a store as small as its contents.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_COMPACTION_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_COMPACTION_H_

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

struct CompactionReport {
  std::int64_t bytes_before = 0;
  std::int64_t bytes_after = 0;
};

// Writes a store that no server has, or a backup, anew beside itself, reads the
// copy whole and puts it in its place: a kill or a power failure leaves either
// the old file or the new one. It needs room for the contents. From then on the
// server gives room back by itself, which it cannot do in a file that a server
// of format 1 or 2 made.
//
// FAILED_PRECONDITION if a server has the store, or another process reads it;
// DATA_LOSS if it is damaged; RESOURCE_EXHAUSTED (STORAGE_FULL) without room.
// After an error the store is as it was.
absl::StatusOr<CompactionReport> CompactStore(const std::string& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_COMPACTION_H_
