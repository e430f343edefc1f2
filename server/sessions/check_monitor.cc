#include "server/sessions/check_monitor.h"

#include "server/base/metrics.h"

namespace revisit::server {

void CheckMonitor::CollectMetrics(Metrics* metrics) const {
  const Counts counts = Read();
  metrics
      ->Gauge("revisit_check_debt",
              "Checks that vehicles in memory owe: those that are stored, and "
              "are still to be made.")
      .Add(counts.debt);
  metrics
      ->Counter("revisit_stored_checks_total",
                "Checks that were made to be stored.")
      .Add(counts.checks);
  metrics
      ->Counter("revisit_stored_candidates_total",
                "Candidates of these that were worth keeping.")
      .Add(counts.candidates);
  metrics
      ->Gauge("revisit_stale_checks",
              "Stored checks of vehicles in memory that wait to be searched "
              "again, since what they depend on has changed.")
      .Add(counts.stale);
  metrics
      ->Counter("revisit_second_searches_total",
                "Searches of checks that were stored before.")
      .Add(counts.second_searches);
  metrics
      ->Histogram("revisit_check_delay_seconds",
                  "Time from when a pose was acknowledged, or its vehicle "
                  "loaded, until its check was stored.")
      .Add(counts.delay_seconds);
}

}  // namespace revisit::server
