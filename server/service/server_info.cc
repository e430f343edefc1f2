#include "server/service/server_info.h"

#include "core/base/build_info.h"
#include "server/conversion/answers.h"
#include "server/sessions/fleet.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

void EncodeResidency(const Fleet::Residency& residency,
                     v1::GetServerInfoResponse* response) {
  response->set_resident_vehicle_count(residency.vehicles);
  response->set_resident_node_count(residency.nodes);
  response->set_resident_bytes(residency.bytes);
}

}  // namespace

absl::Status GetServerInfo(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::GetServerInfoRequest&,
                           v1::GetServerInfoResponse* response) {
  response->set_version(kVersion);
  EncodeDurability(service.storage->GetDurability(), response);
  response->set_store_format(kStoreFormat);
  response->set_max_batch_poses(service.limits.max_batch_poses);
  response->set_takes_pose_columns(true);
  response->set_max_message_bytes(service.limits.max_message_bytes);
  response->set_max_batches_in_flight(service.limits.max_batches_in_flight);
  // A tenant does not learn how much others have on the servers.
  const Caller& caller = call->rights().caller();
  if (!caller.grants || caller.tenant == "*") {
    response->set_over_all_tenants(true);
    EncodeResidency(service.fleet->residency(), response);
    // The server tells what it knows itself also where the store is away.
    if (const auto users = service.storage->ListUsers(); users.ok()) {
      EncodeStorageUsers(*users, response);
    }
  }
  call->End(absl::OkStatus());
  return absl::OkStatus();
}

}  // namespace revisit::server
