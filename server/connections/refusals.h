// How often each limit has refused something.
#ifndef REVISIT_SERVER_CONNECTIONS_REFUSALS_H_
#define REVISIT_SERVER_CONNECTIONS_REFUSALS_H_

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace revisit::server {

class Metrics;

// The limits by the names of their settings, and, where no setting is the
// limit: what a caller's deadline leaves of time, the descriptors that the
// process may open, the policy's budget of a tenant
// (max-search-steps-per-second), a caller's share of max-searches, and the
// memory of calls and the pings of connections that have not had a call let in.
inline constexpr const char* kLimitNames[] = {
    "caller-deadline",
    "descriptors",
    "max-calls",
    "max-calls-per-caller",
    "max-calls-per-vehicle",
    "max-concurrent-streams",
    "max-connections",
    "max-connections-per-address",
    "max-draft-bytes",
    "max-export-bytes",
    "max-idle-bytes",
    "max-memory-bytes",
    "max-queued-bytes",
    "max-queued-bytes-per-vehicle",
    "max-rebuilt-poses",
    "max-rebuilt-poses-per-caller",
    "max-revision-bytes",
    "max-search-rate-per-caller",
    "max-search-steps",
    "max-search-steps-per-second",
    "max-searches",
    "max-searches-per-vehicle",
    "max-searches-share",
    "max-streams",
    "max-streams-per-caller",
    "max-streams-per-vehicle",
    "max-unadmitted-bytes",
    "max-unadmitted-calls",
    "max-unadmitted-connections",
    "max-unadmitted-pings",
};
inline constexpr std::size_t kLimitCount =
    sizeof(kLimitNames) / sizeof(kLimitNames[0]);

// Thread-safe, without locks.
class Refusals {
 public:
  // `limit` is one of kLimitNames; any other is not counted.
  void Count(const char* limit) {
    for (std::size_t i = 0; i < kLimitCount; ++i) {
      if (std::strcmp(kLimitNames[i], limit) == 0) {
        counts_[i].fetch_add(1, std::memory_order_relaxed);
      }
    }
  }

  // Since the start, in the order of the names.
  std::array<std::uint64_t, kLimitCount> Read() const {
    std::array<std::uint64_t, kLimitCount> counts{};
    for (std::size_t i = 0; i < kLimitCount; ++i) {
      counts[i] = counts_[i].load(std::memory_order_relaxed);
    }
    return counts;
  }

  void CollectMetrics(Metrics* metrics) const;

 private:
  std::array<std::atomic<std::uint64_t>, kLimitCount> counts_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_REFUSALS_H_
