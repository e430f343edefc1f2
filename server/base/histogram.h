// How often values of some size were observed, counted without locks.
#ifndef REVISIT_SERVER_BASE_HISTOGRAM_H_
#define REVISIT_SERVER_BASE_HISTOGRAM_H_

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <utility>
#include <vector>

namespace revisit::server {

// A histogram as of one moment.
struct HistogramCounts {
  // Upper bounds of all buckets but the last, which has none; ascending.
  std::vector<double> bounds;
  // Values in each bucket alone, one more than there are bounds; empty where
  // nothing is counted.
  std::vector<std::uint64_t> counts;
  double sum = 0.0;

  // Adds the counts of a histogram with the same bounds.
  void Add(const HistogramCounts& other) {
    if (counts.empty()) {
      *this = other;
      return;
    }
    for (std::size_t i = 0; i < other.counts.size(); ++i) {
      counts[i] += other.counts[i];
    }
    sum += other.sum;
  }
};

// Thread-safe. Sums of values that are observed while it is read may lack one
// of them.
class Histogram {
 public:
  explicit Histogram(std::vector<double> bounds)
      : bounds_(std::move(bounds)), counts_(bounds_.size() + 1) {}

  void Observe(double value) {
    const auto bucket = static_cast<std::size_t>(std::distance(
        bounds_.begin(),
        std::lower_bound(bounds_.begin(), bounds_.end(), value)));
    counts_[bucket].fetch_add(1, std::memory_order_relaxed);
    double sum = sum_.load(std::memory_order_relaxed);
    while (!sum_.compare_exchange_weak(sum, sum + value,
                                       std::memory_order_relaxed)) {
    }
  }

  // Observes a time in seconds.
  void Observe(std::chrono::steady_clock::duration duration) {
    Observe(std::chrono::duration<double>(duration).count());
  }

  HistogramCounts Read() const {
    HistogramCounts result{bounds_, {}, sum_.load(std::memory_order_relaxed)};
    result.counts.reserve(counts_.size());
    for (const std::atomic<std::uint64_t>& count : counts_) {
      result.counts.push_back(count.load(std::memory_order_relaxed));
    }
    return result;
  }

 private:
  const std::vector<double> bounds_;
  std::vector<std::atomic<std::uint64_t>> counts_;
  std::atomic<double> sum_{0.0};
};

// Bounds for times in seconds, from half a millisecond to ten seconds.
inline std::vector<double> SecondsBounds() {
  return {0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05,
          0.1,    0.25,  0.5,    1.0,   2.5,  5.0,   10.0};
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_HISTOGRAM_H_
