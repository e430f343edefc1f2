#include "server/storage/sqlite/store_lock.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <thread>

namespace revisit::server {
namespace {

// Size of the process id with spaces and a line break, so that the states
// behind it stay in their places whatever the id is.
constexpr std::size_t kOwnerBytes = 12;

// Tries to lock, because IsHeld() of another process takes the lock for a
// moment.
constexpr int kTries = 10;
constexpr std::chrono::milliseconds kBetweenTries{20};

// The process id of the owner. The owner writes it right after it has locked,
// so for a moment the file may be empty.
std::string Owner(int file) {
  char buffer[kOwnerBytes];
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

bool Lock(int file) {
  for (int i = 1; flock(file, LOCK_EX | LOCK_NB) != 0; ++i) {
    if (errno != EWOULDBLOCK || i == kTries) return false;
    std::this_thread::sleep_for(kBetweenTries);
  }
  return true;
}

}  // namespace

absl::StatusOr<std::unique_ptr<StoreLock>> StoreLock::Acquire(
    const std::string& store_path) {
  const std::string path = store_path + ".lock";
  const int file = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600);
  if (file < 0) return FromErrno(path);
  auto lock = std::unique_ptr<StoreLock>(new StoreLock(file));
  if (!Lock(file)) {
    if (errno != EWOULDBLOCK) return FromErrno(path);
    return absl::FailedPreconditionError("the store " + store_path +
                                         " is in use by " + Owner(file) +
                                         "; a store has one server at a time");
  }
  // Written in place, which usually works on a full disk too. If it does not,
  // the owner stays unnamed.
  std::string pid = std::to_string(getpid());
  pid.resize(kOwnerBytes - 1, ' ');
  pid += '\n';
  if (pwrite(file, pid.data(), pid.size(), 0) !=
          static_cast<ssize_t>(pid.size()) &&
      errno != ENOSPC) {
    return FromErrno(path);
  }
  return lock;
}

StoreLock::~StoreLock() { close(file_); }

bool StoreLock::IsHeld(const std::string& store_path) {
  const int file = open((store_path + ".lock").c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return false;
  const bool held = flock(file, LOCK_SH | LOCK_NB) != 0 && errno == EWOULDBLOCK;
  close(file);
  return held;
}

std::optional<StoreState> StoreLock::Read(const std::string& store_path) {
  const int file = open((store_path + ".lock").c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return std::nullopt;
  std::array<unsigned char, kStateBytes> bytes{};
  const ssize_t size = pread(file, bytes.data(), bytes.size(), kOwnerBytes);
  close(file);
  if (size != static_cast<ssize_t>(bytes.size())) return std::nullopt;
  return DecodeState(bytes.data());
}

void StoreLock::Write(const StoreState& state) {
  const std::string bytes = Encoded(state);
  const ssize_t written =
      pwrite(file_, bytes.data(), bytes.size(), kOwnerBytes);
  static_cast<void>(written);
}

}  // namespace revisit::server
