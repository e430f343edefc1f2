#include "server/storage/free_space.h"

#include <sys/statvfs.h>

#include <cerrno>
#include <chrono>

#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr std::chrono::seconds kRetryDelay{30};
// Room that must have come after a write found the disk full: more than comes
// and goes by itself there.
constexpr std::int64_t kSomeRoom = std::int64_t{1} << 20;

}  // namespace

absl::StatusOr<std::int64_t> FreeBytes(const std::string& path) {
  struct statvfs file_system;
  if (statvfs(path.c_str(), &file_system) != 0) {
    return absl::ErrnoToStatus(errno, path);
  }
  return static_cast<std::int64_t>(file_system.f_bavail) *
         static_cast<std::int64_t>(file_system.f_frsize);
}

absl::Status StorageFull(const std::string& message) {
  return QuotaExceeded(absl::StatusCode::kResourceExhausted, "STORAGE_FULL",
                       "storage", message, kRetryDelay);
}

absl::Status FreeSpaceGuard::Check() {
  const MutexLock lock(&mutex_);
  if (min_free_bytes_ == 0) return absl::OkStatus();
  const absl::StatusOr<std::int64_t> free = free_bytes_();
  if (free.ok() && *free < Needed()) inside_ = free_bytes_inside_();
  return CheckMark(free);
}

void FreeSpaceGuard::NoteWrite(bool found_full) {
  const MutexLock lock(&mutex_);
  if (!found_full) {
    full_at_.reset();
    return;
  }
  const absl::StatusOr<std::int64_t> free = free_bytes_();
  if (free.ok()) full_at_ = *free;
}

bool FreeSpaceGuard::HasRoom() {
  const MutexLock lock(&mutex_);
  if (min_free_bytes_ != 0 && !CheckMark(free_bytes_()).ok()) return false;
  if (!full_at_.has_value()) return true;
  const absl::StatusOr<std::int64_t> free = free_bytes_();
  return !free.ok() || *free >= *full_at_ + kSomeRoom;
}

std::int64_t FreeSpaceGuard::Needed() const {
  return stopped_ ? EnoughAgain() : min_free_bytes_;
}

std::int64_t FreeSpaceGuard::EnoughAgain() const {
  return min_free_bytes_ + min_free_bytes_ / 4;
}

absl::Status FreeSpaceGuard::CheckMark(
    const absl::StatusOr<std::int64_t>& free) {
  if (!free.ok()) return absl::OkStatus();
  const std::int64_t inside = *free >= min_free_bytes_ / 4 ? inside_ : 0;
  stopped_ = *free < Needed() && *free + inside < Needed();
  if (!stopped_) return absl::OkStatus();
  return StorageFull("nothing was written: the file system of the store has " +
                     std::to_string(*free) + " bytes left and its file " +
                     std::to_string(inside) + ", writes are taken again from " +
                     std::to_string(EnoughAgain()) + " on; reads go on");
}

}  // namespace revisit::server
