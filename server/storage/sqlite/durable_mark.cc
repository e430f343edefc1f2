#include "server/storage/sqlite/durable_mark.h"

#include <fcntl.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <filesystem>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/sqlite/store_files.h"
#include "xxhash.h"

namespace revisit::server {
namespace {

// Marks of formats 1 and 2: magic, salts and frames, all little-endian, then
// XXH3 of the bytes before.
constexpr char kOldMagic[] = "RVSTMRK1";
constexpr std::size_t kOldMagicBytes = 8;
constexpr std::size_t kOldContentBytes = kOldMagicBytes + 3 * 4;
constexpr std::size_t kOldMarkBytes = kOldContentBytes + 8;

std::uint64_t Get(const unsigned char* at, std::size_t size) {
  std::uint64_t value = 0;
  for (std::size_t i = size; i > 0; --i) value = value << 8 | at[i - 1];
  return value;
}

std::optional<LogPosition> DecodeOld(const unsigned char* bytes) {
  if (std::memcmp(bytes, kOldMagic, kOldMagicBytes) != 0 ||
      Get(bytes + kOldContentBytes, 8) !=
          XXH3_64bits(bytes, kOldContentBytes)) {
    return std::nullopt;
  }
  const unsigned char* const numbers = bytes + kOldMagicBytes;
  LogPosition position;
  position.salt1 = static_cast<std::uint32_t>(Get(numbers, 4));
  position.salt2 = static_cast<std::uint32_t>(Get(numbers + 4, 4));
  position.frames = static_cast<std::uint32_t>(Get(numbers + 8, 4));
  return position;
}

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

Mark DurableMark::Read(const std::string& store_path) {
  const std::string path = store_path + ".mark";
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return {};
  std::array<unsigned char, kStateBytes> bytes{};
  const ssize_t size = pread(file, bytes.data(), bytes.size(), 0);
  close(file);
  Mark mark;
  if (size == static_cast<ssize_t>(kStateBytes)) {
    mark.state = DecodeState(bytes.data());
  } else if (size == static_cast<ssize_t>(kOldMarkBytes)) {
    mark.position = DecodeOld(bytes.data());
  }
  return mark;
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
