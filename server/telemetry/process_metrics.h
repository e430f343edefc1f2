// Tells whoever looks on what this process is, and what it takes.
#ifndef REVISIT_SERVER_TELEMETRY_PROCESS_METRICS_H_
#define REVISIT_SERVER_TELEMETRY_PROCESS_METRICS_H_

namespace revisit::server {

class Metrics;

// The build, and, under the names that Prometheus has for every program, time,
// memory and descriptors. Thread-safe.
void CollectProcessMetrics(Metrics* metrics);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_TELEMETRY_PROCESS_METRICS_H_
