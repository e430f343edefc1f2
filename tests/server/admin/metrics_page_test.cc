#include "server/admin/metrics_page.h"

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

// By the text format of Prometheus, version 0.0.4.
TEST(MetricsPageTest, ShowsEachKindAsPrometheusReadsIt) {
  Metrics metrics;
  MetricFamily& counter = metrics.Counter("b_total", "Counts.");
  counter.Add(2, {{"limit", "max-calls"}, {"of", "all"}});
  counter.Add(3, {{"limit", "\"quoted\""}});
  metrics.Gauge("a_bytes", "Is.").Add(0.5);
  metrics.Histogram("c_seconds", "Lasts.")
      .Add(HistogramCounts{{1.0, 2.0}, {4, 0, 1}, 7.5}, {{"method", "Get"}});
  EXPECT_EQ(RenderMetrics(metrics),
            "# HELP b_total Counts.\n"
            "# TYPE b_total counter\n"
            "b_total{limit=\"max-calls\",of=\"all\"} 2\n"
            "b_total{limit=\"\\\"quoted\\\"\"} 3\n"
            "# HELP a_bytes Is.\n"
            "# TYPE a_bytes gauge\n"
            "a_bytes 0.5\n"
            "# HELP c_seconds Lasts.\n"
            "# TYPE c_seconds histogram\n"
            "c_seconds_count{method=\"Get\"} 5\n"
            "c_seconds_sum{method=\"Get\"} 7.5\n"
            "c_seconds_bucket{method=\"Get\",le=\"1\"} 4\n"
            "c_seconds_bucket{method=\"Get\",le=\"2\"} 4\n"
            "c_seconds_bucket{method=\"Get\",le=\"+Inf\"} 5\n");
}

TEST(MetricsPageTest, LeavesOutWhatHasNoSample) {
  Metrics metrics;
  metrics.Counter("never_total", "Counts.");
  EXPECT_EQ(RenderMetrics(metrics), "");
}

}  // namespace
}  // namespace revisit::server
