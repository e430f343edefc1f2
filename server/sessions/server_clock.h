// The server's clock, against which the stamps of poses are held, and nothing
// else: neither order nor ownership depends on it.
#ifndef REVISIT_SERVER_SESSIONS_SERVER_CLOCK_H_
#define REVISIT_SERVER_SESSIONS_SERVER_CLOCK_H_

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <functional>

namespace revisit::server {

// Nanoseconds since the Unix epoch. Thread-safe.
using ServerClock = std::function<std::int64_t()>;

inline std::int64_t SystemNanoseconds() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

// Clocks that are set differ by less. A stamp that is farther ahead is wrong,
// unless the server's clock is.
inline constexpr std::int64_t kMostAheadNanoseconds =
    std::int64_t{5} * 60 * 1'000'000'000;

// The latest stamp that may be right now. A clock before 1970 is one that was
// not set.
inline std::int64_t LatestStamp(const ServerClock& clock) {
  return std::max<std::int64_t>(0, clock()) + kMostAheadNanoseconds;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_SERVER_CLOCK_H_
