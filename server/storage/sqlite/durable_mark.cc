#include "server/storage/sqlite/durable_mark.h"

#include <fcntl.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <filesystem>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite/store_files.h"

namespace revisit::server {
namespace {

absl::Status FromErrno(const std::string& path) {
  const std::string message = absl::ErrnoToStatus(errno, path).ToString();
  if (errno == ENOSPC || errno == EDQUOT) return StorageFull(message);
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
}

}  // namespace

absl::StatusOr<std::unique_ptr<DurableMark>> DurableMark::Open(
    const std::string& store_path) {
  const std::string path = store_path + ".mark";
  const int file = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600);
  if (file < 0) return FromErrno(path);
  return std::unique_ptr<DurableMark>(new DurableMark(path, file));
}

DurableMark::~DurableMark() { close(file_); }

std::optional<StoreState> DurableMark::Read(const std::string& store_path) {
  const std::string path = store_path + ".mark";
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return std::nullopt;
  std::array<unsigned char, kStateBytes> bytes{};
  const ssize_t size = pread(file, bytes.data(), bytes.size(), 0);
  close(file);
  if (size != static_cast<ssize_t>(kStateBytes)) return std::nullopt;
  return DecodeState(bytes.data());
}

void DurableMark::Write(const StoreState& flushed) {
  const std::string bytes = Encoded(flushed);
  const ssize_t written = pwrite(file_, bytes.data(), bytes.size(), 0);
  static_cast<void>(written);
}

absl::Status DurableMark::Flush(const StoreState& flushed) {
  const std::string bytes = Encoded(flushed);
  if (pwrite(file_, bytes.data(), bytes.size(), 0) !=
      static_cast<ssize_t>(bytes.size())) {
    return FromErrno(path_);
  }
  const absl::Status flushed_file = FlushFile(path_);
  if (!flushed_file.ok()) return flushed_file;
  // The file may be new, so its directory is flushed too.
  return FlushFile(std::filesystem::path(path_).parent_path().string());
}

absl::Status DurableMark::Clear() {
  if (ftruncate(file_, 0) != 0 || fsync(file_) != 0) return FromErrno(path_);
  return absl::OkStatus();
}

}  // namespace revisit::server
