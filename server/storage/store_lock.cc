#include "server/storage/store_lock.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>

namespace revisit::server {
namespace {

// The owner writes its id right after it has locked, so for a moment the file
// may be empty.
std::string Owner(int file) {
  char buffer[32];
  const ssize_t size = pread(file, buffer, sizeof buffer, 0);
  std::string digits;
  for (ssize_t i = 0; i < size && buffer[i] >= '0' && buffer[i] <= '9'; ++i) {
    digits += buffer[i];
  }
  return digits.empty() ? "another process" : "process " + digits;
}

absl::Status FromErrno(const std::string& path) {
  return absl::ErrnoToStatus(errno, "cannot lock the store: " + path);
}

}  // namespace

absl::StatusOr<std::unique_ptr<StoreLock>> StoreLock::Acquire(
    const std::string& store_path) {
  const std::string path = store_path + ".lock";
  const int file = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
  if (file < 0) return FromErrno(path);
  auto lock = std::unique_ptr<StoreLock>(new StoreLock(file));
  if (flock(file, LOCK_EX | LOCK_NB) != 0) {
    if (errno != EWOULDBLOCK) return FromErrno(path);
    return absl::FailedPreconditionError("the store " + store_path +
                                         " is in use by " + Owner(file) +
                                         "; a store has one server at a time");
  }
  // In place, where a full disk still has room. If it has not, the owner stays
  // unnamed.
  const std::string pid = std::to_string(getpid()) + "\n";
  const auto size = static_cast<ssize_t>(pid.size());
  if (pwrite(file, pid.data(), pid.size(), 0) != size && errno != ENOSPC) {
    return FromErrno(path);
  }
  if (ftruncate(file, size) != 0) return FromErrno(path);
  return lock;
}

StoreLock::~StoreLock() { close(file_); }

}  // namespace revisit::server
