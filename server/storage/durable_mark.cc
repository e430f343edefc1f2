#include "server/storage/durable_mark.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "server/status.h"
#include "xxhash.h"

namespace revisit::server {
namespace {

// Magic, salts and frames, all little-endian, then XXH3 of what is before.
constexpr char kMagic[] = "RVSTMRK1";
constexpr std::size_t kMagicBytes = 8;
constexpr std::size_t kContentBytes = kMagicBytes + 3 * 4;
constexpr std::size_t kMarkBytes = kContentBytes + 8;
using Bytes = std::array<unsigned char, kMarkBytes>;

void Put(std::uint64_t value, std::size_t size, unsigned char* at) {
  for (std::size_t i = 0; i < size; ++i) {
    at[i] = static_cast<unsigned char>(value >> (8 * i));
  }
}

std::uint64_t Get(const unsigned char* at, std::size_t size) {
  std::uint64_t value = 0;
  for (std::size_t i = size; i > 0; --i) value = value << 8 | at[i - 1];
  return value;
}

Bytes Encoded(const LogPosition& position) {
  Bytes bytes;
  std::memcpy(bytes.data(), kMagic, kMagicBytes);
  Put(position.salt1, 4, bytes.data() + kMagicBytes);
  Put(position.salt2, 4, bytes.data() + kMagicBytes + 4);
  Put(position.frames, 4, bytes.data() + kMagicBytes + 8);
  Put(XXH3_64bits(bytes.data(), kContentBytes), 8,
      bytes.data() + kContentBytes);
  return bytes;
}

absl::Status FromErrno(const std::string& path) {
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               absl::ErrnoToStatus(errno, path).ToString());
}

}  // namespace

absl::StatusOr<std::unique_ptr<DurableMark>> DurableMark::Open(
    const std::string& store_path) {
  const std::string path = store_path + ".mark";
  const int file = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
  if (file < 0) return FromErrno(path);
  return std::unique_ptr<DurableMark>(new DurableMark(path, file));
}

DurableMark::~DurableMark() { close(file_); }

std::optional<LogPosition> DurableMark::Read(const std::string& store_path) {
  const std::string path = store_path + ".mark";
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) return std::nullopt;
  return DurableMark(path, file).Read();
}

std::optional<LogPosition> DurableMark::Read() const {
  Bytes bytes;
  if (pread(file_, bytes.data(), bytes.size(), 0) !=
      static_cast<ssize_t>(bytes.size())) {
    return std::nullopt;
  }
  LogPosition position;
  const unsigned char* const numbers = bytes.data() + kMagicBytes;
  position.salt1 = static_cast<std::uint32_t>(Get(numbers, 4));
  position.salt2 = static_cast<std::uint32_t>(Get(numbers + 4, 4));
  position.frames = static_cast<std::uint32_t>(Get(numbers + 8, 4));
  if (bytes != Encoded(position)) return std::nullopt;
  return position;
}

void DurableMark::Write(const LogPosition& flushed) {
  const Bytes bytes = Encoded(flushed);
  is_flushed_ = false;
  const ssize_t written = pwrite(file_, bytes.data(), bytes.size(), 0);
  static_cast<void>(written);
}

absl::Status DurableMark::Clear() {
  struct stat status;
  const bool is_clear = fstat(file_, &status) == 0 && status.st_size == 0;
  if (is_clear && is_flushed_) return absl::OkStatus();
  if (ftruncate(file_, 0) != 0 || fsync(file_) != 0) return FromErrno(path_);
  is_flushed_ = true;
  return absl::OkStatus();
}

}  // namespace revisit::server
