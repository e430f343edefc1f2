// The port for operators and their probes: what it answers.
#ifndef REVISIT_SERVER_ADMIN_ADMIN_PORT_H_
#define REVISIT_SERVER_ADMIN_ADMIN_PORT_H_

#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/admin/health.h"
#include "server/admin/http_server.h"
#include "server/base/metrics.h"

namespace revisit::server {

// Serves /livez, /readyz and /metrics from now on, as long as the HTTP server
// is there. `collect` gathers all metrics; it is called, on the HTTP server's
// thread, only once the server serves. Errors are those of
// HttpServer::Listen().
absl::StatusOr<std::unique_ptr<HttpServer>> ServeAdminPort(
    const std::string& address, Health* health,
    std::function<void(Metrics*)> collect);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_ADMIN_PORT_H_
