#include "server/base/metrics.h"

#include <chrono>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

std::vector<std::string> NamesOf(const Metrics& metrics) {
  std::vector<std::string> names;
  for (const MetricFamily& family : metrics.families()) {
    names.push_back(family.name());
  }
  return names;
}

TEST(MetricsTest, FamiliesStayInTheOrderInWhichTheyWereMade) {
  Metrics metrics;
  MetricFamily& first = metrics.Counter("b_total", "Second letter.");
  for (int i = 0; i < 100; ++i) {
    metrics.Gauge(("a" + std::to_string(i)).c_str(), "First letter.");
  }
  EXPECT_EQ(&metrics.Counter("b_total", "Second letter."), &first);
  EXPECT_EQ(NamesOf(metrics).size(), 101u);
  EXPECT_EQ(NamesOf(metrics).front(), "b_total");
  EXPECT_EQ(first.help(), "Second letter.");
  EXPECT_EQ(first.kind(), MetricFamily::Kind::kCounter);
}

TEST(MetricsTest, ValuesWithTheSameLabelsAddUpAndOthersStandApart) {
  Metrics metrics;
  metrics.Counter("refusals_total", "By limit.").Add(3, {{"limit", "a"}});
  metrics.Counter("refusals_total", "By limit.").Add(1, {{"limit", "b"}});
  metrics.Counter("refusals_total", "By limit.").Add(4u, {{"limit", "a"}});
  const auto& samples = metrics.families().front().samples();
  ASSERT_EQ(samples.size(), 2u);
  EXPECT_THAT(samples[0].labels,
              ElementsAre(std::pair<std::string, std::string>("limit", "a")));
  EXPECT_EQ(samples[0].value, 7.0);
  EXPECT_EQ(samples[1].value, 1.0);
}

TEST(MetricsTest, TruthIsOneAndATimeIsInSecondsSinceTheUnixEpoch) {
  Metrics metrics;
  MetricFamily& gauge = metrics.Gauge("g", "Help.");
  gauge.Add(true, {{"what", "truth"}});
  gauge.Add(std::chrono::system_clock::time_point(std::chrono::seconds(5)),
            {{"what", "time"}});
  EXPECT_EQ(gauge.samples()[0].value, 1.0);
  EXPECT_EQ(gauge.samples()[1].value, 5.0);
}

TEST(MetricsTest, HistogramThatCountsNothingIsNoSample) {
  Metrics metrics;
  MetricFamily& family = metrics.Histogram("h_seconds", "Help.");
  family.Add(HistogramCounts());
  EXPECT_THAT(family.samples(), IsEmpty());
  family.Add(HistogramCounts{{1.0}, {2, 3}, 9.0});
  ASSERT_EQ(family.samples().size(), 1u);
  EXPECT_THAT(family.samples()[0].histogram.counts, ElementsAre(2, 3));
}

}  // namespace
}  // namespace revisit::server
