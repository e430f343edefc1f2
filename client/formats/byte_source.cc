#include "client/formats/byte_source.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>
#include <zlib.h>
#include <zstd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <string_view>
#include <utility>

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

class Memory : public ByteSource {
 public:
  explicit Memory(std::string bytes) : bytes_(std::move(bytes)) {}

  absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
    const std::size_t count = std::min(size, bytes_.size() - next_);
    std::memcpy(buffer, bytes_.data() + next_, count);
    next_ += count;
    return count;
  }

 private:
  const std::string bytes_;
  std::size_t next_ = 0;
};

class Descriptor : public ByteSource {
 public:
  Descriptor(int fd, std::string path, BeforeWait before_wait)
      : fd_(fd), path_(std::move(path)), before_wait_(std::move(before_wait)) {}
  ~Descriptor() override {
    if (fd_ != STDIN_FILENO) close(fd_);
  }

  absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
    if (before_wait_ != nullptr) Wait();
    for (;;) {
      const ssize_t count = read(fd_, buffer, size);
      if (count >= 0) return static_cast<std::size_t>(count);
      if (errno == EINTR) continue;
      const std::string message =
          absl::StrCat(path_, ": cannot be read: ", std::strerror(errno));
      if (errno == EISDIR) return absl::InvalidArgumentError(message);
      return absl::DataLossError(message);
    }
  }

 private:
  void Wait() const {
    pollfd one = {fd_, POLLIN, 0};
    int milliseconds = 0;
    while (poll(&one, 1, milliseconds) == 0) {
      const auto again = before_wait_();
      if (!again.has_value()) return;
      milliseconds = static_cast<int>(again->count());
    }
  }

  const int fd_;
  const std::string path_;
  const BeforeWait before_wait_;
};

// Reads compressed bytes in pieces for a decompressor.
class Compressed : public ByteSource {
 public:
  Compressed(std::unique_ptr<ByteSource> source, std::string path)
      : source_(std::move(source)), path_(std::move(path)) {}

 protected:
  // Makes sure that `begin_` < `end_`; false at the end.
  absl::StatusOr<bool> Fill() {
    if (begin_ < end_) return true;
    const auto count = source_->Read(buffer_.data(), buffer_.size());
    if (!count.ok()) return count.status();
    begin_ = 0;
    end_ = *count;
    return end_ > 0;
  }

  absl::Status Damaged(const char* what) const {
    return absl::DataLossError(
        absl::StrCat(path_, ": the compressed file is ", what));
  }

  const std::unique_ptr<ByteSource> source_;
  const std::string path_;
  std::array<char, 1 << 16> buffer_;
  std::size_t begin_ = 0;
  std::size_t end_ = 0;
  // Whether the decompressor may have more to say without another byte.
  bool output_left_ = false;
};

class Gzip : public Compressed {
 public:
  using Compressed::Compressed;
  ~Gzip() override { inflateEnd(&stream_); }

  absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
    constexpr int kGzipOnly = 15 + 16;
    for (;;) {
      if (!output_left_) {
        const auto more = Fill();
        if (!more.ok()) return more.status();
        if (!*more) {
          if (inside_) return Damaged("cut off");
          return std::size_t{0};
        }
      }
      if (!inside_) {
        inflateEnd(&stream_);
        stream_ = {};
        if (inflateInit2(&stream_, kGzipOnly) != Z_OK) {
          return absl::ResourceExhaustedError(path_ + ": out of memory");
        }
        inside_ = true;
      }
      stream_.next_in = reinterpret_cast<Bytef*>(buffer_.data() + begin_);
      stream_.avail_in = static_cast<uInt>(end_ - begin_);
      stream_.next_out = reinterpret_cast<Bytef*>(buffer);
      stream_.avail_out = static_cast<uInt>(size);
      const int code = inflate(&stream_, Z_NO_FLUSH);
      begin_ = end_ - stream_.avail_in;
      output_left_ = stream_.avail_out == 0 && code == Z_OK;
      if (code == Z_STREAM_END) {
        inside_ = false;
      } else if (code != Z_OK && code != Z_BUF_ERROR) {
        return Damaged("damaged");
      }
      if (const std::size_t count = size - stream_.avail_out; count > 0) {
        return count;
      }
    }
  }

 private:
  z_stream stream_ = {};
  // Whether a part has begun and not ended.
  bool inside_ = false;
};

class Zstandard : public Compressed {
 public:
  Zstandard(std::unique_ptr<ByteSource> source, std::string path)
      : Compressed(std::move(source), std::move(path)),
        stream_(ZSTD_createDStream(), ZSTD_freeDStream) {}

  absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
    for (;;) {
      bool more = true;
      if (!output_left_) {
        const auto filled = Fill();
        if (!filled.ok()) return filled.status();
        more = *filled;
      }
      // At the end of the input there may still be output.
      if (!more && !inside_) return std::size_t{0};
      ZSTD_outBuffer out = {buffer, size, 0};
      ZSTD_inBuffer in = {buffer_.data(), end_, begin_};
      const std::size_t code = ZSTD_decompressStream(stream_.get(), &out, &in);
      if (ZSTD_isError(code) != 0) return Damaged("damaged");
      begin_ = in.pos;
      inside_ = code != 0;
      output_left_ = inside_ && out.pos == out.size;
      if (out.pos > 0) return out.pos;
      if (!more) return Damaged("cut off");
    }
  }

 private:
  const std::unique_ptr<ZSTD_DStream, decltype(&ZSTD_freeDStream)> stream_;
  bool inside_ = false;
};

// Finds out how the bytes begin, then hands on to what fits. Nothing is read
// before the first call.
class Detecting : public ByteSource {
 public:
  Detecting(std::unique_ptr<ByteSource> source, std::string path)
      : source_(std::move(source)), path_(std::move(path)) {}

  absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
    if (decided_ == nullptr) {
      if (absl::Status status = Decide(); !status.ok()) return status;
    }
    return decided_->Read(buffer, size);
  }

 private:
  // Bytes that were looked at, and then the rest.
  class Rejoined : public ByteSource {
   public:
    Rejoined(std::string head, std::unique_ptr<ByteSource> rest)
        : head_(std::move(head)), rest_(std::move(rest)) {}
    absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) override {
      const auto count = head_.Read(buffer, size);
      return *count > 0 ? count : rest_->Read(buffer, size);
    }

   private:
    Memory head_;
    const std::unique_ptr<ByteSource> rest_;
  };

  absl::Status Decide() {
    constexpr std::string_view kGzip = "\x1f\x8b";
    constexpr std::string_view kZstandard = "\x28\xb5\x2f\xfd";
    std::string head;
    // A pipe may bring the first bytes one by one.
    while (head.size() < kZstandard.size() &&
           (head == kGzip.substr(0, head.size()) ||
            head == kZstandard.substr(0, head.size()))) {
      char next[4];
      const auto count = source_->Read(next, kZstandard.size() - head.size());
      if (!count.ok()) return count.status();
      if (*count == 0) break;
      head.append(next, *count);
    }
    const bool gzip = std::string_view(head).substr(0, 2) == kGzip;
    const bool zstandard = head == kZstandard;
    auto whole =
        std::make_unique<Rejoined>(std::move(head), std::move(source_));
    if (gzip) {
      decided_ = std::make_unique<Gzip>(std::move(whole), path_);
    } else if (zstandard) {
      decided_ = std::make_unique<Zstandard>(std::move(whole), path_);
    } else {
      decided_ = std::move(whole);
    }
    return absl::OkStatus();
  }

  std::unique_ptr<ByteSource> source_;
  const std::string path_;
  std::unique_ptr<ByteSource> decided_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<ByteSource>> OpenBytes(
    const std::string& path, const BeforeWait& before_wait) {
  int fd = STDIN_FILENO;
  if (path != "-") {
    fd = open(path.c_str(), O_RDONLY | O_CLOEXEC);
    if (fd < 0) return absl::ErrnoToStatus(errno, path);
  }
  auto source = std::make_unique<Descriptor>(fd, path, before_wait);
  struct stat status = {};
  if (fstat(fd, &status) == 0 && S_ISDIR(status.st_mode)) {
    return absl::InvalidArgumentError(path +
                                      ": is a directory; expected a file");
  }
  return std::unique_ptr<ByteSource>(
      std::make_unique<Detecting>(std::move(source), path));
}

std::unique_ptr<ByteSource> BytesOf(std::string bytes) {
  return std::make_unique<Detecting>(std::make_unique<Memory>(std::move(bytes)),
                                     "input");
}

}  // namespace revisit::client
