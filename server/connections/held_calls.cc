#include "server/connections/held_calls.h"

#include <algorithm>
#include <utility>

namespace revisit::server {
namespace {

// What gRPC 1.51 takes of the heap for a call whose message has not come, and
// for a byte of its headers: one that stands for a header of the table is 70
// bytes of memory while headers come, and 150 once they are complete.
constexpr std::uint64_t kCallBytes = 24 << 10;
constexpr std::uint64_t kBytesPerHeaderByte = 160;

std::size_t SizeClass(std::uint64_t bytes, std::size_t classes) {
  std::size_t index = 0;
  for (; bytes > 0 && index + 1 < classes; bytes >>= 1) ++index;
  return index;
}

}  // namespace

void HeldCalls::Begin(std::uint64_t bytes) {
  Complete();
  has_open_ = true;
  open_ = bytes;
  ++count_;
  bytes_ += bytes;
}

void HeldCalls::Grow(std::uint64_t bytes) {
  // Headers that go on without having begun: gRPC ends the connection.
  if (!has_open_) return;
  open_ += bytes;
  bytes_ += bytes;
}

void HeldCalls::Complete() {
  if (!std::exchange(has_open_, false)) return;
  Calls& calls = by_size_[SizeClass(open_, by_size_.size())];
  ++calls.count;
  calls.bytes += open_;
}

void HeldCalls::End(std::uint64_t calls) {
  for (Calls& held : by_size_) {
    if (calls == 0) return;
    const std::uint64_t ended = std::min(calls, held.count);
    if (ended == 0) continue;
    const std::uint64_t bytes =
        ended == held.count ? held.bytes : held.bytes / held.count * ended;
    held.count -= ended;
    held.bytes -= bytes;
    count_ -= ended;
    bytes_ -= bytes;
    calls -= ended;
  }
}

std::uint64_t HeldCalls::memory() const {
  return count_ * kCallBytes + bytes_ * kBytesPerHeaderByte;
}

}  // namespace revisit::server
