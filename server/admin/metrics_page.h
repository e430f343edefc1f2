// The page of metrics that Prometheus reads. docs/operate.md lists all of them.
#ifndef REVISIT_SERVER_ADMIN_METRICS_PAGE_H_
#define REVISIT_SERVER_ADMIN_METRICS_PAGE_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "server/base/logging.h"
#include "server/connections/admission.h"
#include "server/connections/refusals.h"
#include "server/security/gatekeeper.h"
#include "server/security/tls_files.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_census.h"
#include "server/storage/store_note.h"
#include "server/telemetry/audit_log.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {

class Storage;

inline constexpr char kMetricsContentType[] =
    "text/plain; version=0.0.4; charset=utf-8";

// What counts in the server. It is read anew for each page; null is left out.
struct MetricsSources {
  const ServiceCounters* calls = nullptr;
  const Admission* admission = nullptr;
  const Refusals* connection_refusals = nullptr;
  std::function<std::int64_t()> accepted_connections;
  const Fleet* fleet = nullptr;
  const VehicleCensus* census = nullptr;
  Storage* storage = nullptr;
  // Below which the store refuses writes; see ServerSettings.
  std::int64_t min_free_bytes = 0;
  // Empty if the store is a database.
  std::string store_file;
  // How the server of the store's file before this one ended, as it was noted.
  std::optional<StoreNote> last_exit;
  const TlsFiles* tls_files = nullptr;
  const Gatekeeper* gatekeeper = nullptr;
  const Log* log = nullptr;
  const AuditLog* audit = nullptr;
  bool draining = false;
};

// In the text format of Prometheus, version 0.0.4.
std::string RenderMetrics(const MetricsSources& sources);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_METRICS_PAGE_H_
