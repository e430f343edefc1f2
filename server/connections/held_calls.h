// Estimates the memory that gRPC holds for the calls that a connection has
// begun. What each brought is known from its frames, how many are over from
// gRPC's counts, but not which: the smallest are taken to be over first, so
// that the estimate errs upwards.
#ifndef REVISIT_SERVER_CONNECTIONS_HELD_CALLS_H_
#define REVISIT_SERVER_CONNECTIONS_HELD_CALLS_H_

#include <array>
#include <cstddef>
#include <cstdint>

namespace revisit::server {

// Thread-compatible.
class HeldCalls {
 public:
  // A call begins; its headers have `bytes` on the wire so far.
  void Begin(std::uint64_t bytes);
  // The headers of the call that began last go on, or have come to their end.
  void Grow(std::uint64_t bytes);
  void Complete();
  // So many more calls are over.
  void End(std::uint64_t calls);

  std::uint64_t count() const { return count_; }
  // Bytes.
  std::uint64_t memory() const;

 private:
  struct Calls {
    std::uint64_t count = 0;
    std::uint64_t bytes = 0;
  };

  // Calls whose headers have come to their end, with 2^(i-1) to 2^i - 1 bytes.
  std::array<Calls, 40> by_size_{};
  // Bytes of the headers of the call that began last, if they go on: it cannot
  // be over.
  std::uint64_t open_ = 0;
  bool has_open_ = false;
  std::uint64_t count_ = 0;
  // Bytes of all headers.
  std::uint64_t bytes_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_HELD_CALLS_H_
