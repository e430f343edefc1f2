#include "server/admin/admin_port.h"

#include <utility>

#include "server/admin/metrics_page.h"

namespace revisit::server {

absl::StatusOr<std::unique_ptr<HttpServer>> ServeAdminPort(
    const std::string& address, Health* health,
    std::function<void(Metrics*)> collect) {
  return HttpServer::Listen(
      address,
      [health,
       collect = std::move(collect)](const std::string& path) -> HttpResponse {
        if (path == "/livez") return health->Liveness();
        if (path == "/readyz") return health->Readiness();
        if (path != "/metrics") {
          return {404, "there are /metrics, /livez and /readyz\n"};
        }
        if (health->phase() == Health::Phase::kStarting) {
          return {503, "starting\n"};
        }
        Metrics metrics;
        collect(&metrics);
        return {200, RenderMetrics(metrics), kMetricsContentType};
      });
}

}  // namespace revisit::server
