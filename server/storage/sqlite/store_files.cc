#include "server/storage/sqlite/store_files.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <system_error>

#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr char kFileInDirectory[] = "revisit.sqlite";
// Size of the reserve: room to delete a vehicle, and for the index of a log of
// 256 MiB.
constexpr off_t kReserveBytes = 1 << 20;
// Bytes that are written at a time when a file is written anew.
constexpr std::size_t kPieceBytes = std::size_t{1} << 20;

std::string InDirectory(const std::string& path) {
  return (std::filesystem::path(path) / kFileInDirectory).string();
}

std::string ReserveOf(const std::string& store_path) {
  return store_path + ".reserve";
}

absl::Status FlushFailed(const std::string& path) {
  const int failure = errno;
  return Error(
      absl::StatusCode::kUnavailable, "STORE_SYNC_FAILED",
      "cannot flush: " + absl::ErrnoToStatus(failure, path).ToString());
}

absl::Status Unavailable(const std::string& message) {
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
}

// Returns whether all of the file could be written and flushed; if not, errno
// says why.
bool WriteAnew(int file) {
  std::vector<char> piece(kPieceBytes);
  off_t at = 0;
  while (true) {
    const ssize_t size = pread(file, piece.data(), piece.size(), at);
    if (size < 0) return false;
    if (size == 0) return fsync(file) == 0;
    const ssize_t written =
        pwrite(file, piece.data(), static_cast<std::size_t>(size), at);
    if (written < 0) return false;
    at += written;
  }
}

}  // namespace

absl::StatusOr<std::string> StoreFileToServe(const std::string& path) {
  std::error_code error;
  if (std::filesystem::is_regular_file(path, error)) return path;
  const absl::Status made = MakeDirectory(path);
  if (!made.ok()) return made;
  return InDirectory(path);
}

absl::StatusOr<std::string> ExistingStoreFile(const std::string& path) {
  std::error_code error;
  for (const std::string& file : {path, InDirectory(path)}) {
    if (std::filesystem::is_regular_file(file, error)) return file;
  }
  for (const std::string& file : {path, InDirectory(path)}) {
    if (!FilesBeside(file).empty()) return file;
  }
  return absl::NotFoundError(("there is no store at " + path).c_str());
}

std::string LogOf(const std::string& store_path) { return store_path + "-wal"; }

std::int64_t BytesOf(const std::string& path) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(path, error);
  return error ? 0 : static_cast<std::int64_t>(bytes);
}

absl::Status FlushFile(const std::string& path) {
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0 && errno == ENOENT) return absl::OkStatus();
  const absl::Status status =
      file >= 0 && fsync(file) == 0 ? absl::OkStatus() : FlushFailed(path);
  if (file >= 0) close(file);
  return status;
}

absl::Status FlushAnew(const std::string& path) {
  const int file = open(path.c_str(), O_RDWR | O_CLOEXEC);
  if (file < 0 && errno == ENOENT) return absl::OkStatus();
  const absl::Status status =
      file >= 0 && WriteAnew(file) ? absl::OkStatus() : FlushFailed(path);
  if (file >= 0) close(file);
  return status;
}

absl::Status FlushDirectories(const std::string& directory) {
  std::filesystem::path path = std::filesystem::path(directory);
  struct stat first;
  struct stat status;
  if (stat(path.c_str(), &first) != 0) return absl::OkStatus();
  while (stat(path.c_str(), &status) == 0 && status.st_dev == first.st_dev) {
    const int file = open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    // A process that may not read a directory has made nothing in it.
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

absl::Status MakeDirectory(const std::string& path) {
  std::error_code error;
  std::filesystem::path directory =
      std::filesystem::absolute(path, error).lexically_normal();
  // The parent of "store/" is "store", so the trailing slash is dropped.
  if (!directory.has_filename()) directory = directory.parent_path();
  if (std::filesystem::is_directory(directory, error)) return absl::OkStatus();
  const std::filesystem::path parent = directory.parent_path();
  if (parent != directory) {
    const absl::Status made = MakeDirectory(parent.string());
    if (!made.ok()) return made;
  }
  if (mkdir(directory.c_str(), 0700) != 0 && errno != EEXIST) {
    return Unavailable(
        "cannot create the directory " +
        absl::ErrnoToStatus(errno, directory.string()).ToString());
  }
  return absl::OkStatus();
}

absl::Status MakePrivateFile(const std::string& path) {
  const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
  if (file < 0) {
    return absl::ErrnoToStatus(errno, "cannot create " + path);
  }
  close(file);
  return absl::OkStatus();
}

std::vector<std::string> FilesBeside(const std::string& store_path) {
  std::vector<std::string> files;
  for (const char* suffix :
       {"-wal", "-shm", "-journal", ".mark", ".lock", ".reserve"}) {
    std::error_code error;
    if (std::filesystem::exists(store_path + suffix, error)) {
      files.push_back(store_path + suffix);
    }
  }
  return files;
}

void KeepReserve(const std::string& store_path) {
  const std::string path = ReserveOf(store_path);
  const int file =
      open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
  if (file < 0) return;
  if (posix_fallocate(file, 0, kReserveBytes) != 0) unlink(path.c_str());
  close(file);
}

bool GiveUpReserve(const std::string& store_path) {
  return unlink(ReserveOf(store_path).c_str()) == 0;
}

FileWatch::FileWatch(const std::string& store_path) {
  // The files that stay as long as the store is open.
  for (const char* suffix : {"", "-wal", "-shm", ".mark", ".lock"}) {
    const std::string path = store_path + suffix;
    struct stat status;
    if (stat(path.c_str(), &status) == 0) {
      files_.push_back({path, status.st_dev, status.st_ino});
    }
  }
}

absl::Status FileWatch::Check() const {
  for (const File& file : files_) {
    struct stat status;
    const bool is_there = stat(file.path.c_str(), &status) == 0;
    // Without the right to look, nothing is known.
    if (!is_there && errno != ENOENT && errno != ENOTDIR) continue;
    // While the file is open here, no other file gets its inode number.
    if (is_there && status.st_dev == file.device &&
        status.st_ino == file.inode) {
      continue;
    }
    return Unavailable("the file " + file.path + " was " +
                       (is_there ? "replaced" : "removed") +
                       " while the server had it open");
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
