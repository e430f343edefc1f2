#include "server/base/metrics.h"

#include <algorithm>

namespace revisit::server {

void MetricFamily::Add(std::chrono::system_clock::time_point time,
                       Labels labels) {
  Add(std::chrono::duration<double>(time.time_since_epoch()).count(),
      std::move(labels));
}

void MetricFamily::Add(const HistogramCounts& counts, Labels labels) {
  if (counts.counts.empty()) return;
  SampleOf(std::move(labels)).histogram.Add(counts);
}

MetricFamily::Sample& MetricFamily::SampleOf(Labels labels) {
  const auto found = std::find_if(
      samples_.begin(), samples_.end(),
      [&](const Sample& sample) { return sample.labels == labels; });
  if (found != samples_.end()) return *found;
  return samples_.emplace_back(Sample{std::move(labels), 0.0, {}});
}

MetricFamily& Metrics::Family(const char* name, const char* help,
                              MetricFamily::Kind kind) {
  const auto found = std::find_if(
      families_.begin(), families_.end(),
      [&](const MetricFamily& family) { return family.name() == name; });
  if (found != families_.end()) return *found;
  return families_.emplace_back(name, help, kind);
}

}  // namespace revisit::server
