// Stops writes before the disk is full.
//
// A full disk is worse than an almost full one: SQLite needs room to copy its
// log even to start, and whatever else lives there fails too.
#ifndef REVISIT_SERVER_STORAGE_FREE_SPACE_H_
#define REVISIT_SERVER_STORAGE_FREE_SPACE_H_

#include <cstdint>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

// Bytes that an ordinary user may still write to the file system of a path.
absl::StatusOr<std::int64_t> FreeBytes(const std::string& path);

// RESOURCE_EXHAUSTED (STORAGE_FULL) with QuotaFailure, and RetryInfo of half a
// minute.
absl::Status StorageFull(const std::string& message);

// One thread at a time.
class FreeSpaceGuard {
 public:
  // Once less than `min_free_bytes` were free, writes wait until a quarter more
  // than that is. 0 never stops them. What is free inside the store's own file
  // counts too, as long as the file system has a quarter of the bytes: the log
  // needs some.
  FreeSpaceGuard(std::int64_t min_free_bytes,
                 std::function<absl::StatusOr<std::int64_t>()> free_bytes,
                 std::function<std::int64_t()> free_bytes_inside)
      : min_free_bytes_(min_free_bytes),
        free_bytes_(std::move(free_bytes)),
        free_bytes_inside_(std::move(free_bytes_inside)) {}

  // OK, or StorageFull(). A file system that does not tell stops nothing.
  absl::Status Check();

 private:
  const std::int64_t min_free_bytes_;
  const std::function<absl::StatusOr<std::int64_t>()> free_bytes_;
  const std::function<std::int64_t()> free_bytes_inside_;
  bool stopped_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_FREE_SPACE_H_
