#include "server/sessions/retention_monitor.h"

#include "server/base/metrics.h"

namespace revisit::server {

void RetentionMonitor::CollectMetrics(Metrics* metrics) const {
  const Counts counts = Read();
  metrics
      ->Counter("revisit_poses_dropped_total",
                "Poses that vehicles no longer keep.")
      .Add(counts.poses);
  MetricFamily& nodes = metrics->Counter(
      "revisit_nodes_dropped_total",
      "Nodes of these poses, by the setting that no longer keeps them.");
  nodes.Add(counts.nodes_too_old, {{"rule", "max_age"}});
  nodes.Add(counts.nodes_covered, {{"rule", "max_passes"}});
  metrics
      ->Histogram("revisit_drop_seconds",
                  "Time in which a vehicle's appends waited while poses that "
                  "it no longer keeps were dropped.")
      .Add(counts.seconds);
  metrics
      ->Gauge("revisit_trimmed_vehicles",
              "Vehicles whose history is looked at for poses to drop, or that "
              "are losing such poses.")
      .Add(counts.vehicles);
}

}  // namespace revisit::server
