#include "server/service/list_vehicles.h"

#include <memory>
#include <string>

#include "server/conversion/answers.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/service/readable_page.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Fills a page with the vehicles that the caller may read, as they are stored.
absl::Status ListStored(Storage* storage, const Caller& caller,
                        const std::string& list, const std::string& after,
                        int page_size, v1::ListVehiclesResponse* response) {
  const absl::StatusOr<std::string> last = FillReadablePage(
      caller, Resource::kVehicle, after, page_size,
      [&](const std::string& place, const std::string& prefix, int limit) {
        return storage->ListVehicles(place, prefix, limit);
      },
      [&](const VehicleRecord& record) {
        v1::Vehicle* const vehicle = response->add_vehicles();
        EncodeVehicle(record, vehicle);
        return vehicle->ByteSizeLong();
      });
  if (!last.ok()) return last.status();
  if (!last->empty()) {
    response->set_next_page_token(MakePageToken(list, *last));
  }
  return absl::OkStatus();
}

// Replaces the stored state of vehicles that are in memory by their present
// one, each when its session comes to it, then finishes the call.
void FillFromMemory(Fleet* fleet, const UnaryCallPtr& call,
                    v1::ListVehiclesResponse* response) {
  // The last to let go of it finishes the call.
  const std::shared_ptr<void> finish(
      nullptr, [call](void*) { call->End(absl::OkStatus()); });
  for (v1::Vehicle& vehicle : *response->mutable_vehicles()) {
    const std::string id = vehicle.name().substr(VehicleName("").size());
    const auto session = fleet->SessionIfLoaded(id);
    if (session == nullptr) continue;
    session->Read([finish, session = std::weak_ptr<VehicleSession>(session),
                   &vehicle](const absl::StatusOr<VehicleView>& view) {
      // The vehicle may have been deleted or unloaded meanwhile: then its
      // stored state stands.
      if (!view.ok()) return;
      if (vehicle.state() == v1::VEHICLE_STATE_DAMAGED && view->damage.ok()) {
        if (const auto loaded = session.lock()) loaded->LoadAnew();
        return;
      }
      vehicle.Clear();
      EncodeVehicle(*view, &vehicle);
    });
  }
}

}  // namespace

absl::Status ListVehicles(const ServiceContext& service,
                          const UnaryCallPtr& call,
                          const v1::ListVehiclesRequest& request,
                          v1::ListVehiclesResponse* response) {
  const absl::StatusOr<AskedPage> asked = PageOf("ListVehicles", request);
  if (!asked.ok()) return asked.status();
  service.executor->Post([=, storage = service.storage, fleet = service.fleet] {
    const absl::Status status =
        ListStored(storage, call->rights().caller(), asked->list, asked->after,
                   asked->size, response);
    if (status.ok()) {
      FillFromMemory(fleet, call, response);
    } else {
      call->End(status);
    }
  });
  return absl::OkStatus();
}

}  // namespace revisit::server
