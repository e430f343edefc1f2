#include "server/storage/free_space.h"

#include <sys/statvfs.h>

#include <cerrno>
#include <chrono>

#include "server/status.h"

namespace revisit::server {
namespace {

constexpr std::chrono::seconds kRetryDelay{30};

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
  if (min_free_bytes_ == 0) return absl::OkStatus();
  const absl::StatusOr<std::int64_t> free = free_bytes_();
  if (!free.ok()) return absl::OkStatus();
  const std::int64_t enough = min_free_bytes_ + min_free_bytes_ / 4;
  const std::int64_t needed = stopped_ ? enough : min_free_bytes_;
  std::int64_t inside = 0;
  if (*free < needed && *free >= min_free_bytes_ / 4) {
    inside = free_bytes_inside_();
  }
  stopped_ = *free + inside < needed;
  if (!stopped_) return absl::OkStatus();
  return StorageFull("nothing was written: the file system of the store has " +
                     std::to_string(*free) + " bytes left and its file " +
                     std::to_string(inside) +
                     ", writes are taken again from " +
                     std::to_string(enough) + " on; reads go on");
}

}  // namespace revisit::server
