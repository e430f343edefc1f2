#include "server/storage/store_files.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>

#include "server/status.h"

namespace revisit::server {
namespace {

// The index of a log of 64 MiB takes 64 kB.
constexpr off_t kReserveBytes = 256 << 10;

std::string ReserveOf(const std::string& store_path) {
  return store_path + ".reserve";
}

}  // namespace

std::string LogOf(const std::string& store_path) { return store_path + "-wal"; }

absl::Status FlushFile(const std::string& path) {
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0 && errno == ENOENT) return absl::OkStatus();
  const bool flushed = file >= 0 && fsync(file) == 0;
  const int failure = errno;
  if (file >= 0) close(file);
  if (flushed) return absl::OkStatus();
  return Error(
      absl::StatusCode::kUnavailable, "STORE_SYNC_FAILED",
      "cannot flush: " + absl::ErrnoToStatus(failure, path).ToString());
}

absl::Status FlushDirectories(const std::string& directory) {
  std::filesystem::path path = std::filesystem::path(directory);
  struct stat first;
  struct stat status;
  if (stat(path.c_str(), &first) != 0) return absl::OkStatus();
  while (stat(path.c_str(), &status) == 0 && status.st_dev == first.st_dev) {
    const int file = open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    // Nobody who may not read it has made something in it.
    if (file < 0) return absl::OkStatus();
    const bool failed = fsync(file) != 0 && errno == EIO;
    close(file);
    if (failed) {
      return Error(absl::StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                   "cannot flush the directory " + path.string());
    }
    if (path == path.parent_path()) break;
    path = path.parent_path();
  }
  return absl::OkStatus();
}

void KeepReserve(const std::string& store_path) {
  const std::string path = ReserveOf(store_path);
  const int file =
      open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0644);
  if (file < 0) return;
  if (posix_fallocate(file, 0, kReserveBytes) != 0) unlink(path.c_str());
  close(file);
}

bool GiveUpReserve(const std::string& store_path) {
  return unlink(ReserveOf(store_path).c_str()) == 0;
}

}  // namespace revisit::server
