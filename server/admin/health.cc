#include "server/admin/health.h"

#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include <cstdint>
#include <string>

#include "server/admin/store_health.h"
#include "server/base/metrics.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// How long the server may leave its own question without an answer and count as
// alive: its threads are busy rather than stuck.
constexpr std::chrono::milliseconds kLivenessPatience{10'000};

}  // namespace

void Health::Serve(Storage* storage, class Drain* drain, Executor* executor,
                   grpc::Server* server) {
  storage_ = storage;
  server_ = server;
  store_timer_ =
      FollowStore(storage, drain, server->GetHealthCheckService(), log_);
  const auto make_check = [&] {
    return std::make_unique<SelfCheck>(
        server->InProcessChannel(grpc::ChannelArguments()), executor);
  };
  watchdog_check_ = make_check();
  {
    const MutexLock lock(&mutex_);
    probe_check_ = make_check();
  }
  phase_ = Phase::kServing;
}

void Health::Drain() {
  phase_ = Phase::kDraining;
  // Stopped first: it would overwrite the health that is set here.
  store_timer_.reset();
  if (auto* health = server_->GetHealthCheckService()) {
    health->SetServingStatus(false);
  }
}

void Health::EndChecks() {
  watchdog_check_.reset();
  const MutexLock lock(&mutex_);
  probe_check_.reset();
}

bool Health::Answers(std::chrono::milliseconds patience) {
  return watchdog_check_->Answers(patience);
}

HttpResponse Health::Liveness() {
  std::chrono::milliseconds silence{0};
  {
    const MutexLock lock(&mutex_);
    if (probe_check_ != nullptr) silence = probe_check_->Silence();
  }
  if (silence < kLivenessPatience) return {200, "alive\n"};
  log_->Write(LogLevel::kWarning, "liveness_not_answered",
              {{"waited_ms", static_cast<std::int64_t>(silence.count())}});
  return {503, "its threads have not answered for " +
                   std::to_string(silence.count() / 1000) + " s\n"};
}

HttpResponse Health::Readiness() const {
  switch (phase_) {
    case Phase::kStarting:
      return {503, "starting\n"};
    case Phase::kDraining:
      return {503, "draining\n"};
    case Phase::kServing:
      break;
  }
  if (const absl::Status status = storage_->CheckWritable(); !status.ok()) {
    return {503, "not writable: " + std::string(status.message()) + "\n"};
  }
  return {200, "ready\n"};
}

void Health::CollectMetrics(Metrics* metrics) const {
  metrics
      ->Gauge("revisit_draining",
              "Whether the server has been asked to end, and calls go home.")
      .Add(phase_ == Phase::kDraining);
}

}  // namespace revisit::server
