// Whether this server is up, for all who ask: the health service of gRPC, the
// probes of an orchestrator, a watchdog.
#ifndef REVISIT_SERVER_ADMIN_HEALTH_H_
#define REVISIT_SERVER_ADMIN_HEALTH_H_

#include <atomic>
#include <chrono>
#include <memory>

#include "core/base/mutex.h"
#include "server/admin/http_server.h"
#include "server/admin/self_check.h"
#include "server/base/logging.h"
#include "server/base/periodic.h"
#include "server/connections/drain.h"
#include "server/sessions/executor.h"

namespace grpc {
class Server;
}  // namespace grpc

namespace revisit::server {

class Metrics;
class Storage;

// One thread calls Serve(), Drain(), EndChecks() and Answers(); all others are
// thread-safe.
class Health {
 public:
  // The phases of a server's life, in this order.
  enum class Phase { kStarting, kServing, kDraining };

  // The log must outlive this.
  explicit Health(const Log* log) : log_(log) {}

  Health(const Health&) = delete;
  Health& operator=(const Health&) = delete;

  // The server serves. From now on health says so as long as the store does
  // (store_health.h), and the server may be asked whether it answers. Storage
  // and drain must live until Drain(), server and executor until EndChecks(),
  // or all of them until this is gone.
  void Serve(Storage* storage, class Drain* drain, Executor* executor,
             grpc::Server* server);
  // Says NOT_SERVING from now on. May be called again.
  void Drain();
  // The server is not asked any more whether it answers. Comes before gRPC's
  // server ends: the questions' channels are connections too.
  void EndChecks();

  Phase phase() const { return phase_; }

  // Whether the server answers within `patience` (self_check.h). REQUIRES: it
  // is between Serve() and EndChecks().
  bool Answers(std::chrono::milliseconds patience);

  // Whether the process works: 200, or 503 once its threads have left a
  // question without an answer for long. Returns at once.
  HttpResponse Liveness();
  // Whether calls should come here: 200, or 503 with why not.
  HttpResponse Readiness() const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  const Log* const log_;
  std::atomic<Phase> phase_{Phase::kStarting};
  // Set before the phase is kServing.
  Storage* storage_ = nullptr;
  grpc::Server* server_ = nullptr;
  std::unique_ptr<Periodic> store_timer_;
  std::unique_ptr<SelfCheck> watchdog_check_;
  Mutex mutex_;
  // Null unless the server may be asked.
  std::unique_ptr<SelfCheck> probe_check_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_HEALTH_H_
