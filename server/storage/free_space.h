// Stops writes before the disk is full.
//
// A full disk is worse than an almost full one: SQLite needs room to copy its
// log even to start, and whatever else lives there fails too.
#ifndef REVISIT_SERVER_STORAGE_FREE_SPACE_H_
#define REVISIT_SERVER_STORAGE_FREE_SPACE_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"

namespace revisit::server {

// Bytes that an ordinary user may still write to the file system of a path.
absl::StatusOr<std::int64_t> FreeBytes(const std::string& path);

// RESOURCE_EXHAUSTED (STORAGE_FULL) with QuotaFailure, and RetryInfo of half a
// minute.
absl::Status StorageFull(const std::string& message);

// Thread-safe.
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

  // OK, or StorageFull(). A file system that does not tell stops nothing. Asks
  // for the bytes inside, so that it belongs to the thread that may.
  absl::Status Check();

  // Notes whether a write that was tried found the disk full, which without a
  // mark is the only way to tell.
  void NoteWrite(bool found_full);

  // Whether the next write is likely to find room, so that callers may be told
  // before they try: by what Check() found inside last, there is enough, and
  // after a write that found the disk full some room has come since.
  bool HasRoom();

 private:
  absl::Status CheckMark(const absl::StatusOr<std::int64_t>& free)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::int64_t Needed() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // From here on writes that were stopped are taken again.
  std::int64_t EnoughAgain() const;

  const std::int64_t min_free_bytes_;
  const std::function<absl::StatusOr<std::int64_t>()> free_bytes_;
  const std::function<std::int64_t()> free_bytes_inside_;
  Mutex mutex_;
  bool stopped_ ABSL_GUARDED_BY(mutex_) = false;
  // Free bytes inside the store's file, when that was last asked for.
  std::int64_t inside_ ABSL_GUARDED_BY(mutex_) = 0;
  // Free bytes when a write found the disk full; nothing if the last one did
  // not.
  std::optional<std::int64_t> full_at_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_FREE_SPACE_H_
