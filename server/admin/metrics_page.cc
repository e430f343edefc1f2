#include "server/admin/metrics_page.h"

#include <prometheus/metric_family.h>
#include <prometheus/text_serializer.h>

#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

namespace revisit::server {
namespace {

prometheus::MetricType TypeOf(MetricFamily::Kind kind) {
  switch (kind) {
    case MetricFamily::Kind::kCounter:
      return prometheus::MetricType::Counter;
    case MetricFamily::Kind::kGauge:
      return prometheus::MetricType::Gauge;
    case MetricFamily::Kind::kHistogram:
      return prometheus::MetricType::Histogram;
  }
  return prometheus::MetricType::Untyped;
}

// Prometheus has each bucket count those below it too.
prometheus::ClientMetric::Histogram Cumulated(const HistogramCounts& counts) {
  prometheus::ClientMetric::Histogram histogram;
  for (std::size_t i = 0; i < counts.counts.size(); ++i) {
    histogram.sample_count += counts.counts[i];
    histogram.bucket.push_back({histogram.sample_count,
                                i < counts.bounds.size()
                                    ? counts.bounds[i]
                                    : std::numeric_limits<double>::infinity()});
  }
  histogram.sample_sum = counts.sum;
  return histogram;
}

prometheus::ClientMetric Translated(const MetricFamily::Sample& sample) {
  prometheus::ClientMetric metric;
  for (const auto& [name, value] : sample.labels) {
    metric.label.push_back({name, value});
  }
  // A value that is not of the family's type is not shown.
  metric.counter.value = sample.value;
  metric.gauge.value = sample.value;
  metric.histogram = Cumulated(sample.histogram);
  return metric;
}

}  // namespace

std::string RenderMetrics(const Metrics& metrics) {
  std::vector<prometheus::MetricFamily> families;
  for (const MetricFamily& from : metrics.families()) {
    if (from.samples().empty()) continue;
    prometheus::MetricFamily family;
    family.name = from.name();
    family.help = from.help();
    family.type = TypeOf(from.kind());
    for (const MetricFamily::Sample& sample : from.samples()) {
      family.metric.push_back(Translated(sample));
    }
    families.push_back(std::move(family));
  }
  return prometheus::TextSerializer().Serialize(families);
}

}  // namespace revisit::server
