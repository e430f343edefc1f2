// Tells operators how the stored checks of a fleet come along.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_MONITOR_H_
#define REVISIT_SERVER_SESSIONS_CHECK_MONITOR_H_

#include <atomic>
#include <chrono>
#include <cstdint>

#include "server/base/histogram.h"

namespace revisit::server {

class Metrics;

// Thread-safe, without locks.
class CheckMonitor {
 public:
  struct Counts {
    // Checks that vehicles in memory owe.
    std::int64_t debt = 0;
    // Checks that were made, and candidates of them that were kept.
    std::uint64_t checks = 0;
    std::uint64_t candidates = 0;
    // Checks of vehicles in memory that are to be searched again, and that
    // were.
    std::int64_t stale = 0;
    std::uint64_t second_searches = 0;
    // From when the pose of a check was acknowledged, or the vehicle loaded,
    // until the check was stored.
    HistogramCounts delay_seconds;
  };

  void Owes(std::int64_t more) { debt_ += more; }
  void Made(std::uint64_t candidates) {
    ++checks_;
    candidates_ += candidates;
  }
  void Stale(std::int64_t more) { stale_ += more; }
  void SearchedAgain() { ++second_searches_; }
  void Stored(std::chrono::steady_clock::duration delay) {
    delay_.Observe(delay);
  }

  Counts Read() const {
    return {debt_,  checks_,          candidates_,
            stale_, second_searches_, delay_.Read()};
  }

  void CollectMetrics(Metrics* metrics) const;

 private:
  std::atomic<std::int64_t> debt_{0};
  std::atomic<std::uint64_t> checks_{0};
  std::atomic<std::uint64_t> candidates_{0};
  std::atomic<std::int64_t> stale_{0};
  std::atomic<std::uint64_t> second_searches_{0};
  // Debts of hours are what is to be seen.
  Histogram delay_{{0.01, 0.1, 1.0, 10.0, 60.0, 600.0, 3600.0, 86400.0}};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_MONITOR_H_
