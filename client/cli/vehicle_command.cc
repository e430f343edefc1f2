#include "client/cli/vehicle_command.h"

#include "client/cli/names.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {

void PrintVehicle(const v1::Vehicle& vehicle, const Console& console) {
  const v1::VehicleSettings& settings = vehicle.settings();
  std::vector<std::pair<std::string, std::string>> fields = {
      {"name", vehicle.name()},
      {"state", NameOf(vehicle.state())},
      {"created",
       google::protobuf::util::TimeUtil::ToString(vehicle.create_time())},
      {"durable poses", std::to_string(vehicle.durable_sequence())},
      {"revision", std::to_string(vehicle.revision())},
      {"nodes", std::to_string(vehicle.node_count())},
      {"loop closures", std::to_string(vehicle.loop_closure_count())},
      {"travelled", Fixed(vehicle.travelled_meters(), 1) + " m"},
      {"state space", NameOf(settings.state_space())},
      {"correlation model", NameOf(settings.correlation_model())},
      {"likelihood form", NameOf(settings.likelihood_form())},
      {"coordinate frame", NameOf(settings.coordinate_frame())},
      {"node spacing", Fixed(settings.node_spacing_meters(), 2) + " m"},
      {"sequence length", Fixed(settings.sequence_length_meters(), 2) + " m"},
      {"check interval", Fixed(settings.check_interval_meters(), 2) + " m"},
      {"maximal step", Fixed(settings.max_step_meters(), 2) + " m"},
      {"gate probability", Fixed(settings.gate_probability(), 4)},
      {"place tolerance",
       Fixed(settings.place_tolerance().position_meters(), 2) + " m, " +
           Fixed(settings.place_tolerance().heading_radians(), 4) + " rad"},
      {"candidate separation",
       Fixed(settings.candidate_separation_meters(), 2) + " m"},
      {"maximal candidates", std::to_string(settings.max_candidates())}};
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
  if (console.json) {
    console.out << ToJson(response->vehicle(), true) << '\n';
  } else {
    PrintVehicle(response->vehicle(), console);
  }
  return absl::OkStatus();
}

absl::Status RunVehicleGet(const Client& client, const std::string& id,
                           const Console& console) {
  v1::GetVehicleRequest request;
  request.set_name(VehicleName(id));
  const auto response = client.GetVehicle(request);
  if (!response.ok()) return response.status();
  if (console.json) {
    console.out << ToJson(response->vehicle(), true) << '\n';
  } else {
    PrintVehicle(response->vehicle(), console);
  }
  return absl::OkStatus();
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
    table.AddRow(
        {vehicle.name(), NameOf(vehicle.state()),
         std::to_string(vehicle.durable_sequence()),
         std::to_string(vehicle.revision()),
         std::to_string(vehicle.loop_closure_count()),
         NameOf(vehicle.settings().state_space()),
         NameOf(vehicle.settings().correlation_model()),
         google::protobuf::util::TimeUtil::ToString(vehicle.create_time())});
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
