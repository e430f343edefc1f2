#include "client/cli/commands/vehicle_command.h"

#include <vector>

#include "client/cli/names.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {

namespace {

using Fields = std::vector<std::pair<std::string, std::string>>;

std::string Meters(double value) { return Fixed(value, 2) + " m"; }

std::string Text(const v1::PlaceTolerance& tolerance) {
  return Meters(tolerance.position_meters()) + ", " +
         Fixed(tolerance.heading_radians(), 4) + " rad";
}

// Of a damaged vehicle it may be lost.
std::string CreateTime(const v1::Vehicle& vehicle) {
  return vehicle.has_create_time()
             ? google::protobuf::util::TimeUtil::ToString(vehicle.create_time())
             : "unknown";
}

void AddConsistency(const v1::Consistency& consistency, Fields* fields) {
  fields->emplace_back(
      "verified",
      std::to_string(consistency.confirmed_count()) + " confirmed, " +
          std::to_string(consistency.rejected_count()) + " rejected");
  if (consistency.has_mean_normalized_innovation_squared()) {
    fields->emplace_back(
        "squared innovation",
        Fixed(consistency.mean_normalized_innovation_squared(), 2) +
            " in the mean, " +
            std::to_string(consistency.degrees_of_freedom()) +
            " if the claimed uncertainty is honest");
  }
  fields->emplace_back(
      "inflation", Fixed(consistency.inflation(), 2) +
                       (consistency.applied() ? ", applied" : ", not applied"));
}

absl::Status Print(const v1::Vehicle& vehicle, const Console& console) {
  if (console.json) {
    console.out << ToJson(vehicle, true) << '\n';
  } else {
    PrintVehicle(vehicle, console);
  }
  return absl::OkStatus();
}

}  // namespace

void PrintVehicle(const v1::Vehicle& vehicle, const Console& console) {
  const v1::VehicleSettings& settings = vehicle.settings();
  Fields fields = {
      {"name", vehicle.name()},
      {"uid", vehicle.uid()},
      {"state", NameOf(vehicle.state())},
      {"created", CreateTime(vehicle)},
      {"durable poses", std::to_string(vehicle.durable_sequence())},
      {"revision", std::to_string(vehicle.revision())},
      {"nodes", std::to_string(vehicle.node_count())},
      {"loop closures", std::to_string(vehicle.loop_closure_count())},
      {"travelled", Fixed(vehicle.travelled_meters(), 1) + " m"},
      {"state space", NameOf(settings.state_space())},
      {"correlation model", NameOf(settings.correlation_model())},
      {"alignment", NameOf(settings.alignment())},
      {"likelihood form", NameOf(settings.likelihood_form())},
      {"coordinate frame", NameOf(settings.coordinate_frame())},
      {"node spacing", Meters(settings.node_spacing_meters())},
      {"sequence length", Meters(settings.sequence_length_meters())},
      {"check interval", Meters(settings.check_interval_meters())},
      {"maximal step", Meters(settings.max_step_meters())},
      {"gate probability", Fixed(settings.gate_probability(), 4)},
      {"acceptance probability", Fixed(settings.acceptance_probability(), 4)},
      {"place tolerance", Text(settings.place_tolerance())},
      {"shape tolerance", Text(settings.shape_tolerance())},
      {"shape correlation", Meters(settings.shape_correlation_meters())},
      {"road spacing", Meters(settings.road_spacing_meters())},
      {"candidate separation", Meters(settings.candidate_separation_meters())},
      {"maximal candidates", std::to_string(settings.max_candidates())},
      {"maximal inflation", Fixed(settings.max_inflation(), 2)}};
  if (vehicle.has_consistency()) AddConsistency(vehicle.consistency(), &fields);
  if (settings.has_geodetic_origin()) {
    const v1::GeodeticPosition& origin = settings.geodetic_origin();
    fields.emplace_back("geodetic origin",
                        Fixed(origin.latitude_degrees(), 8) + " deg, " +
                            Fixed(origin.longitude_degrees(), 8) + " deg, " +
                            Fixed(origin.height_meters(), 3) + " m");
  }
  PrintFields(fields, console.out);
}

absl::Status RunVehicleCreate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& settings,
                              const Console& console) {
  v1::CreateVehicleRequest request;
  request.set_vehicle_id(id);
  *request.mutable_vehicle()->mutable_settings() = settings;
  const auto response = client.CreateVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), console);
}

absl::Status RunVehicleGet(const Client& client, const std::string& id,
                           const Console& console) {
  v1::GetVehicleRequest request;
  request.set_name(VehicleName(id));
  const auto response = client.GetVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), console);
}

absl::Status RunVehicleUpdate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& changes,
                              const Console& console) {
  std::vector<const google::protobuf::FieldDescriptor*> changed;
  v1::VehicleSettings::GetReflection()->ListFields(changes, &changed);
  v1::UpdateVehicleRequest request;
  request.mutable_vehicle()->set_name(VehicleName(id));
  *request.mutable_vehicle()->mutable_settings() = changes;
  for (const auto* field : changed) {
    request.mutable_update_mask()->add_paths("settings." + field->name());
  }
  const auto response = client.UpdateVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), console);
}

absl::Status RunVehicleAcceptLoss(const Client& client, const std::string& id,
                                  std::uint64_t durable_sequence,
                                  const Console& console) {
  v1::AcceptDataLossRequest request;
  request.set_name(VehicleName(id));
  request.set_durable_sequence(durable_sequence);
  const auto response = client.AcceptDataLoss(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), console);
}

absl::Status RunVehicleList(const Client& client, const Console& console) {
  v1::ListVehiclesResponse all;
  v1::ListVehiclesRequest request;
  request.set_page_size(1000);
  do {
    const auto page = client.ListVehicles(request);
    if (!page.ok()) return page.status();
    all.mutable_vehicles()->MergeFrom(page->vehicles());
    request.set_page_token(page->next_page_token());
  } while (!request.page_token().empty());
  if (console.json) {
    console.out << ToJson(all, true) << '\n';
    return absl::OkStatus();
  }
  using Align = Table::Align;
  Table table({{"VEHICLE", Align::kLeft},
               {"STATE", Align::kLeft},
               {"POSES", Align::kRight},
               {"REVISION", Align::kRight},
               {"CLOSURES", Align::kRight},
               {"SPACE", Align::kLeft},
               {"MODEL", Align::kLeft},
               {"CREATED", Align::kLeft}});
  for (const v1::Vehicle& vehicle : all.vehicles()) {
    table.AddRow({vehicle.name(), NameOf(vehicle.state()),
                  std::to_string(vehicle.durable_sequence()),
                  std::to_string(vehicle.revision()),
                  std::to_string(vehicle.loop_closure_count()),
                  NameOf(vehicle.settings().state_space()),
                  NameOf(vehicle.settings().correlation_model()),
                  CreateTime(vehicle)});
  }
  table.Print(console.out);
  return absl::OkStatus();
}

absl::Status RunVehicleDelete(const Client& client,
                              const std::vector<std::string>& ids,
                              const Console& console) {
  for (const std::string& id : ids) {
    v1::DeleteVehicleRequest request;
    request.set_name(VehicleName(id));
    const auto response = client.DeleteVehicle(request);
    if (!response.ok()) return response.status();
    if (!console.json) console.out << "deleted " << request.name() << '\n';
  }
  if (console.json) console.out << "{}\n";
  return absl::OkStatus();
}

}  // namespace revisit::client
