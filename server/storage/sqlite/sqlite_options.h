// How a store in a SQLite file is opened.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_OPTIONS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_OPTIONS_H_

#include <cstdint>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

struct SqliteOptions : WriteGroupOptions {
  // Name of SQLite's layer to the operating system; empty for the usual one.
  // Tests put one here whose device fails.
  std::string vfs;
  // Writes other than deletions of vehicles are RESOURCE_EXHAUSTED
  // (STORAGE_FULL) while less than this is free; see free_space.h.
  std::int64_t min_free_bytes = 0;
  // The largest file that is checked whole when it is opened.
  std::int64_t max_checked_bytes = std::int64_t{256} << 20;
  // Whether to drop the unreadable part of a damaged log, rather than refuse to
  // open the store.
  bool drop_damaged_log = false;
  // Called while the store is opened, with what an operator should know.
  std::function<void(const std::string&)> warn;
  // Called once, on the writer's thread, when no write will be taken any more
  // because a flush has failed or the store's files are gone.
  std::function<void(const absl::Status&)> on_failure;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_OPTIONS_H_
