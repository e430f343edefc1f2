// Finds the heads of HTTP/2 frames (RFC 9113, 4.1) in what a client sends, so
// that it is known before gRPC acts on it how many calls it begins.
#ifndef REVISIT_SERVER_CONNECTIONS_FRAME_READER_H_
#define REVISIT_SERVER_CONNECTIONS_FRAME_READER_H_

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace revisit::server {

// The types that matter here (RFC 9113, 6).
enum class FrameType : std::uint8_t {
  kData = 0x0,
  kHeaders = 0x1,
  kPriority = 0x2,
  kResetStream = 0x3,
  kSettings = 0x4,
  kPing = 0x6,
  kWindowUpdate = 0x8,
  kContinuation = 0x9,
};

struct FrameHead {
  // Bytes that follow the head; those of a frame that gRPC refuses as too long
  // may never come.
  std::uint32_t length;
  FrameType type;
  // Whether a frame of settings, or a ping, answers the other side's.
  bool is_answer;
  // Whether headers come to their end with this frame.
  bool ends_headers;
};

// Reads one direction of one connection, in pieces of any size. A client that
// does not speak HTTP/2 is read as if it did; gRPC ends its connection.
// Thread-compatible.
class FrameReader {
 public:
  // Takes bytes off the front of what came; true once a head has ended with
  // the last byte taken, false once all are taken.
  bool Next(const unsigned char** bytes, std::size_t* count, FrameHead* head) {
    while (*count > 0) {
      const bool is_head = skip_ == 0;
      const std::size_t taken =
          std::min<std::size_t>(*count, is_head ? head_.size() - have_ : skip_);
      if (is_head) std::memcpy(head_.data() + have_, *bytes, taken);
      *bytes += taken;
      *count -= taken;
      if (!is_head) {
        skip_ -= static_cast<std::uint32_t>(taken);
        continue;
      }
      have_ += taken;
      if (have_ < head_.size()) return false;
      have_ = 0;
      skip_ = std::uint32_t{head_[0]} << 16 | std::uint32_t{head_[1]} << 8 |
              std::uint32_t{head_[2]};
      *head = {skip_, static_cast<FrameType>(head_[3]), (head_[4] & 0x1) != 0,
               (head_[4] & 0x4) != 0};
      return true;
    }
    return false;
  }

  // Bytes of the current frame that are still to come.
  std::size_t left_of_frame() const { return skip_; }

 private:
  // Length of the preface that stands before all frames (RFC 9113, 3.4).
  static constexpr std::uint32_t kPrefaceBytes = 24;

  // Bytes until the next head begins.
  std::uint32_t skip_ = kPrefaceBytes;
  std::array<unsigned char, 9> head_{};
  // Bytes of the next head that have come.
  std::size_t have_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_FRAME_READER_H_
