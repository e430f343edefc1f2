// The page of metrics that Prometheus reads.
#ifndef REVISIT_SERVER_ADMIN_METRICS_PAGE_H_
#define REVISIT_SERVER_ADMIN_METRICS_PAGE_H_

#include <string>

#include "server/base/metrics.h"

namespace revisit::server {

class Storage;

inline constexpr char kMetricsContentType[] =
    "text/plain; version=0.0.4; charset=utf-8";

// In the text format of Prometheus, version 0.0.4. Families without a sample
// are left out.
std::string RenderMetrics(const Metrics& metrics);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_METRICS_PAGE_H_
