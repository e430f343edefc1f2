#include "server/connections/refusals.h"

#include "server/base/metrics.h"

namespace revisit::server {

void Refusals::CollectMetrics(Metrics* metrics) const {
  MetricFamily& refusals = metrics->Counter(
      "revisit_limit_refusals_total",
      "Calls, batches and connections that a limit has refused or cut.");
  const std::array<std::uint64_t, kLimitCount> counts = Read();
  for (std::size_t i = 0; i < kLimitCount; ++i) {
    refusals.Add(counts[i], {{"limit", kLimitNames[i]}});
  }
}

}  // namespace revisit::server
