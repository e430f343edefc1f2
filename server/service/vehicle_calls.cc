#include "server/service/vehicle_calls.h"

#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/settings.h"
#include "server/base/status.h"
#include "server/conversion/answers.h"
#include "server/conversion/names.h"
#include "server/conversion/vehicle_labels.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/field_violations.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/sessions/vehicle_uid.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// The part of a vehicle that a caller gets who changed the vehicle but may not
// read it: which one it is. The caller's own settings are added to that.
v1::Vehicle IdentityOf(const v1::Vehicle& vehicle) {
  v1::Vehicle identity;
  identity.set_name(vehicle.name());
  identity.set_uid(vehicle.uid());
  return identity;
}

// The config of the vehicle that the request describes.
absl::StatusOr<VehicleConfig> NewConfig(
    const v1::CreateVehicleRequest& request) {
  const FieldPath field = kRequest.Field("vehicle");
  absl::StatusOr<VehicleConfig> config =
      DecodeSettings(request.vehicle().settings(), field.Field("settings"));
  if (!config.ok()) return config;
  const LabelsMask all = {true, true, {}};
  if (absl::Status status =
          UpdateLabels(request.vehicle(), all, field, &*config);
      !status.ok()) {
    return status;
  }
  config->create_time_ns = NowNanoseconds();
  config->uid = NewUuid();
  return config;
}

// OK if the caller may have checks of a vehicle search in this group: one of
// the vehicle's tenant that the caller may read, which need not be there.
absl::Status CheckGroupOfChecks(const VehicleConfig& config,
                                const std::string& vehicle_id,
                                UnaryCall* call) {
  const std::string& group = config.check_group;
  if (group.empty()) return absl::OkStatus();
  if (absl::Status status =
          call->rights().AlsoNeeds(Verb::kRead, group, Resource::kGroup);
      !status.ok()) {
    return status;
  }
  if (call->rights().caller().AreOfOneTenant(group, vehicle_id)) {
    return absl::OkStatus();
  }
  return InvalidField(
      kInvalidField,
      kRequest.Field("vehicle").Field("settings").Field("check_group"),
      absl::StrCat("got ", Quoted(GroupName(group)),
                   ", which is of another tenant than the vehicle"));
}

// Creates a vehicle, or finds the one of that name that is there. A vehicle
// that is deleted between the two is created anew: a creation never finds
// nothing.
void CreateOrFind(Fleet* fleet, const UnaryCallPtr& call, const std::string& id,
                  const VehicleConfig& config, const CreateCallback& created,
                  const ViewCallback& found) {
  fleet->Create(id, config, [=](const absl::StatusOr<CreatedVehicle>& made) {
    if (!absl::IsAlreadyExists(made.status())) {
      created(made);
      return;
    }
    fleet->Session(id)->Read([=](const absl::StatusOr<VehicleView>& view) {
      if (absl::IsNotFound(view.status()) && !call->given_up()) {
        CreateOrFind(fleet, call, id, config, created, found);
      } else {
        found(view);
      }
    });
  });
}

// The vehicle as a caller may see it who asked for one of this config.
// `created`: its view, or its record.
template <typename Created>
void EncodeCreated(const Created& created, const VehicleConfig& config,
                   bool may_read, v1::Vehicle* vehicle) {
  EncodeVehicle(created, vehicle);
  if (may_read) return;
  *vehicle = IdentityOf(*vehicle);
  EncodeSettings(config, vehicle->mutable_settings());
}

absl::Status VehicleExists(const std::string& id) {
  return Error(absl::StatusCode::kAlreadyExists, "VEHICLE_EXISTS",
               absl::StrCat(VehicleName(id),
                            " exists with other settings; change them with "
                            "UpdateVehicle, or take another id"));
}

// The config as the request changes it. Takes room where nodes move.
absl::StatusOr<VehicleConfig> ChangedConfig(
    const VehicleView& view, const v1::UpdateVehicleRequest& request,
    UnaryCall* call) {
  if (call->given_up()) return call->GivenUpStatus();
  absl::StatusOr<VehicleConfig> config =
      UpdateConfig(view.config, view.durable_sequence > 0, request.vehicle(),
                   request.update_mask());
  if (!config.ok()) return config;
  if (config->check_group != view.config.check_group) {
    const absl::Status status = CheckGroupOfChecks(*config, view.id, call);
    if (!status.ok()) return status;
  }
  if (!core::MovesNodes(view.config.drive, config->drive)) {
    return config;
  }
  const absl::Status room = call->room().TakeRebuild(view.durable_sequence);
  if (!room.ok()) return room;
  return config;
}

// The vehicle as a caller may see it who changed it.
void EncodeUpdated(const VehicleView& view,
                   const v1::UpdateVehicleRequest& request, bool may_read,
                   v1::Vehicle* vehicle) {
  EncodeVehicle(view, vehicle);
  if (may_read) return;
  const v1::Vehicle whole = *vehicle;
  TrimToMask(request.update_mask(), vehicle);
  // An origin that was left out may be that of the first pose.
  if (!request.vehicle().settings().has_geodetic_origin()) {
    vehicle->mutable_settings()->clear_geodetic_origin();
  }
  vehicle->MergeFrom(IdentityOf(whole));
}

}  // namespace

absl::Status CreateVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::CreateVehicleRequest& request,
                           v1::CreateVehicleResponse* response) {
  const std::string& id = request.vehicle_id();
  if (absl::Status status = CheckId(id, kRequest.Field("vehicle_id"));
      !status.ok()) {
    return status;
  }
  if (absl::Status status = call->ChooseVehicle(id); !status.ok()) {
    return status;
  }
  absl::StatusOr<VehicleConfig> decoded = NewConfig(request);
  if (!decoded.ok()) return decoded.status();
  if (service.limits.store_checks_by_default &&
      request.vehicle().settings().checks() == v1::STORED_CHECKS_UNSPECIFIED) {
    decoded->checks = ChecksKept::kStored;
  }
  const VehicleConfig& config = *decoded;
  if (absl::Status status = CheckGroupOfChecks(config, id, call.get());
      !status.ok()) {
    return status;
  }
  // `vehicle`: its view, or its record.
  const auto encode = [=](const auto& vehicle) {
    EncodeCreated(vehicle, config, MayRead(*call, vehicle.id),
                  response->mutable_vehicle());
    return absl::OkStatus();
  };
  const auto created = [=](const CreatedVehicle& made) {
    return made.view != nullptr ? encode(*made.view) : encode(made.record);
  };
  const auto found = [=](const VehicleView& view) {
    if (!view.config_is_known || !SameSettings(view.config, config)) {
      return VehicleExists(view.id);
    }
    return encode(view);
  };
  CreateOrFind(service.fleet, call, id, config,
               FinishWith<CreatedVehicle>(call, created),
               FinishWith<VehicleView>(call, found));
  return absl::OkStatus();
}

absl::Status GetVehicle(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::GetVehicleRequest& request,
                        v1::GetVehicleResponse* response) {
  const auto session =
      SessionOf(service, request.name(), kRequest.Field("name"), call.get());
  if (!session.ok()) return session.status();
  (*session)->Read(FinishWith<VehicleView>(call, [=](const auto& view) {
    EncodeVehicle(view, response->mutable_vehicle());
    return absl::OkStatus();
  }));
  return absl::OkStatus();
}

absl::Status UpdateVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::UpdateVehicleRequest& request,
                           v1::UpdateVehicleResponse* response) {
  const auto session =
      SessionOf(service, request.vehicle().name(),
                kRequest.Field("vehicle").Field("name"), call.get());
  if (!session.ok()) return session.status();
  (*session)->Update(
      [call, request = &request](const VehicleView& view) {
        return ChangedConfig(view, *request, call.get());
      },
      FinishWith<VehicleView>(
          call, [=, request = &request](const VehicleView& view) {
            EncodeUpdated(view, *request, MayRead(*call, view.id),
                          response->mutable_vehicle());
            return absl::OkStatus();
          }));
  return absl::OkStatus();
}

absl::Status DeleteVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::DeleteVehicleRequest& request,
                           v1::DeleteVehicleResponse*) {
  const absl::StatusOr<std::string> id =
      ParseVehicleName(request.name(), kRequest.Field("name"));
  if (!id.ok()) return id.status();
  if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
    return status;
  }
  service.fleet->Delete(
      *id, [call](const absl::Status& status) { call->End(status); });
  return absl::OkStatus();
}

absl::Status AcceptDataLoss(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::AcceptDataLossRequest& request,
                            v1::AcceptDataLossResponse* response) {
  const auto session =
      SessionOf(service, request.name(), kRequest.Field("name"), call.get());
  if (!session.ok()) return session.status();
  (*session)->AcceptDataLoss(
      request.durable_sequence(),
      FinishWith<VehicleView>(
          call, [=, counts = service.counts](const VehicleView& view) {
            counts->Decided(Decision::kDataLossAccepted);
            v1::Vehicle* const vehicle = response->mutable_vehicle();
            EncodeVehicle(view, vehicle);
            if (MayRead(*call, view.id)) return absl::OkStatus();
            *vehicle = IdentityOf(*vehicle);
            vehicle->set_state(v1::VEHICLE_STATE_ACTIVE);
            return absl::OkStatus();
          }));
  return absl::OkStatus();
}

}  // namespace revisit::server
