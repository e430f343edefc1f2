// The server's counts, as of one moment. Each class that counts says what it
// counts, in a function CollectMetrics(): its name, help and kind. Who shows
// them (server/admin/metrics_page.h) knows none of the names.
//
// A name ends with its unit (_seconds, _bytes), or, for a counter, with _total.
// docs/operate.md lists all names.
#ifndef REVISIT_SERVER_BASE_METRICS_H_
#define REVISIT_SERVER_BASE_METRICS_H_

#include <chrono>
#include <deque>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "server/base/histogram.h"

namespace revisit::server {

// Values of one name, told apart by their labels. Labels come from fixed sets,
// so that their number does not grow with use.
class MetricFamily {
 public:
  // kCounter: counts since the start, which never fall. kGauge: what is now.
  enum class Kind { kCounter, kGauge, kHistogram };
  // Name and value of each.
  using Labels = std::vector<std::pair<std::string, std::string>>;
  struct Sample {
    Labels labels;
    // The value of a counter or a gauge.
    double value = 0.0;
    // The value of a histogram.
    HistogramCounts histogram;
  };

  MetricFamily(const char* name, const char* help, Kind kind)
      : name_(name), help_(help), kind_(kind) {}

  // Values with the same labels add up, where several parts of the server count
  // the same. True is 1.
  template <typename Number,
            typename = std::enable_if_t<std::is_arithmetic_v<Number>>>
  void Add(Number value, Labels labels = {}) {
    SampleOf(std::move(labels)).value += static_cast<double>(value);
  }
  // A time, since the Unix epoch.
  void Add(std::chrono::system_clock::time_point time, Labels labels = {});
  // Does nothing where nothing is counted.
  void Add(const HistogramCounts& counts, Labels labels = {});

  const std::string& name() const { return name_; }
  const std::string& help() const { return help_; }
  Kind kind() const { return kind_; }
  // In the order in which they were added first.
  const std::vector<Sample>& samples() const { return samples_; }

 private:
  Sample& SampleOf(Labels labels);

  std::string name_;
  std::string help_;
  Kind kind_;
  std::vector<Sample> samples_;
};

// Not thread-safe.
class Metrics {
 public:
  // The family of this name, which is made if it is not there. It stays where
  // it is as long as this.
  MetricFamily& Counter(const char* name, const char* help) {
    return Family(name, help, MetricFamily::Kind::kCounter);
  }
  MetricFamily& Gauge(const char* name, const char* help) {
    return Family(name, help, MetricFamily::Kind::kGauge);
  }
  MetricFamily& Histogram(const char* name, const char* help) {
    return Family(name, help, MetricFamily::Kind::kHistogram);
  }

  // In the order in which they were made. Some may be without a sample.
  const std::deque<MetricFamily>& families() const { return families_; }

 private:
  MetricFamily& Family(const char* name, const char* help,
                       MetricFamily::Kind kind);

  std::deque<MetricFamily> families_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_METRICS_H_
