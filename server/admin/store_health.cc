#include "server/admin/store_health.h"

#include <grpcpp/health_check_service_interface.h>

#include <chrono>

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Names in the health service for everything.
constexpr const char* kServiceHealth[] = {
    "", v1::PoseGraphService::service_full_name()};
// The name for writes alone: reads go on while the store takes no writes.
constexpr char kWriteHealth[] = "revisit.v1.PoseGraphService/write";

// How often the server looks. Callers of a server whose lease has run out wait
// up to that much longer.
constexpr std::chrono::milliseconds kPeriod{500};

void SetHealth(grpc::HealthCheckServiceInterface* health, bool is_serving) {
  if (health == nullptr) return;
  for (const char* const name : kServiceHealth) {
    health->SetServingStatus(name, is_serving);
  }
}

void SetWriteHealth(grpc::HealthCheckServiceInterface* health,
                    bool is_serving) {
  if (health != nullptr) health->SetServingStatus(kWriteHealth, is_serving);
}

// A server that is cut off from a shared store may not answer once its lease
// has run out: then others take its vehicles, and calls go to them only if
// health says so and those that are here end.
void FollowLease(const absl::Status& lease, Drain* drain,
                 grpc::HealthCheckServiceInterface* health, const Log* log) {
  if (lease.ok()) {
    drain->Resume();
    SetHealth(health, true);
    log->Write(LogLevel::kInfo, "store_in_reach_again", {});
    return;
  }
  // First, so that those whose calls end find another server.
  SetHealth(health, false);
  log->Write(LogLevel::kWarning, "store_out_of_reach",
             {{"reason", ReasonOf(lease)}});
  drain->Suspend(lease);
}

void FollowWrites(const absl::Status& writable,
                  grpc::HealthCheckServiceInterface* health, const Log* log) {
  SetWriteHealth(health, writable.ok());
  if (writable.ok()) {
    log->Write(LogLevel::kInfo, "writes_taken_again", {});
  } else {
    log->Write(LogLevel::kWarning, "writes_refused",
               {{"reason", ReasonOf(writable)}});
  }
}

}  // namespace

std::unique_ptr<Periodic> FollowStore(Storage* storage, Drain* drain,
                                      grpc::HealthCheckServiceInterface* health,
                                      const Log* log) {
  SetHealth(health, true);
  SetWriteHealth(health, true);
  auto timer = std::make_unique<Periodic>(
      kPeriod, [=, held = true, written = true]() mutable {
        const absl::Status lease = storage->CheckLease();
        if (lease.ok() != held) FollowLease(lease, drain, health, log);
        held = lease.ok();
        const absl::Status writable = storage->CheckWritable();
        if (writable.ok() != written) FollowWrites(writable, health, log);
        written = writable.ok();
      });
  // A server may start on a full disk.
  timer->Hasten();
  return timer;
}

}  // namespace revisit::server
