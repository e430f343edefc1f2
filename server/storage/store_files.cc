#include "server/storage/store_files.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>

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
