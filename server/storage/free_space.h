// Stops writes before the disk is full.
//
// A full disk is worse than an almost full one: SQLite needs room to copy its
// log even to start, and other programs that use the disk fail too.
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
  // Once less than `min_free_bytes` were free, writes are refused until a
  // quarter more than that is free. 0 never refuses. Free bytes inside the
  // store's own file count too, as long as the file system has a quarter of
  // `min_free_bytes`: the log needs some.
  FreeSpaceGuard(std::int64_t min_free_bytes,
                 std::function<absl::StatusOr<std::int64_t>()> free_bytes,
                 std::function<std::int64_t()> free_bytes_inside)
      : min_free_bytes_(min_free_bytes),
        free_bytes_(std::move(free_bytes)),
        free_bytes_inside_(std::move(free_bytes_inside)) {}

  // OK, or StorageFull(). OK if the file system does not say how much is free.
  // Asks for the bytes inside, so only the thread that may do that calls it.
  absl::Status Check();

  // Notes whether a write that was tried found the disk full: with
  // `min_free_bytes` 0 nothing else shows it.
  void NoteWrite(bool found_full);

  // Whether the next write is likely to find room, so that callers can be
  // refused before they try. There has to be enough room, counting the bytes
  // inside as of the last Check(), and after a write that found the disk full,
  // some more than there was then.
  bool HasRoom();

 private:
  absl::Status CheckMark(const absl::StatusOr<std::int64_t>& free)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::int64_t Needed() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Free bytes from which on writes are taken again.
  std::int64_t EnoughAgain() const;

  const std::int64_t min_free_bytes_;
  const std::function<absl::StatusOr<std::int64_t>()> free_bytes_;
  const std::function<std::int64_t()> free_bytes_inside_;
  Mutex mutex_;
  bool stopped_ ABSL_GUARDED_BY(mutex_) = false;
  // Free bytes inside the store's file at the last Check().
  std::int64_t inside_ ABSL_GUARDED_BY(mutex_) = 0;
  // Free bytes when a write found the disk full; nullopt if the last one did
  // not.
  std::optional<std::int64_t> full_at_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_FREE_SPACE_H_
