#include "client/cli/commands/vehicle_command.h"

#include <map>
#include <memory>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/revisit/printable_text.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

using Fields = std::vector<std::pair<std::string, std::string>>;

// A damaged vehicle may have lost it.
std::string CreateTime(const v1::Vehicle& vehicle) {
  return vehicle.has_create_time()
             ? google::protobuf::util::TimeUtil::ToString(vehicle.create_time())
             : "unknown";
}

void AddConsistency(const v1::Consistency& consistency, Fields* fields) {
  fields->emplace_back(
      "verified", absl::StrCat(consistency.confirmed_count(), " confirmed, ",
                               consistency.rejected_count(), " rejected"));
  if (consistency.has_mean_normalized_innovation_squared()) {
    fields->emplace_back(
        "squared innovation",
        absl::StrCat(Fixed(consistency.mean_normalized_innovation_squared(), 2),
                     " in the mean, ", consistency.degrees_of_freedom(),
                     " if the claimed uncertainty is honest"));
  }
  fields->emplace_back(
      "inflation",
      absl::StrCat(Fixed(consistency.inflation(), 2),
                   consistency.applied() ? ", applied" : ", not applied"));
}

absl::Status Print(const v1::Vehicle& vehicle, const Terminal& terminal) {
  if (terminal.json()) {
    terminal.out << ToJson(vehicle, true) << '\n';
  } else if (terminal.names()) {
    terminal.out << Printable(vehicle.name()) << '\n';
  } else {
    PrintVehicle(vehicle, terminal);
  }
  return absl::OkStatus();
}

void AddId(const Command& command, std::string* id,
           const std::string& help = "") {
  command.AddText("ID", "TEXT", id, help).Required();
}

void AddCreate(const Command& vehicle) {
  const Command command = vehicle.AddCommand(
      {"create",
       "Creates a vehicle. Again with the same settings: the existing one.",
       "An id has 1 to 63 lower-case letters, digits and dashes, and neither "
       "begins nor ends\nwith a dash; upper case and underscores are refused. "
       "Map names of your own the same way\neverywhere: a VIN to lower case, "
       "so "
       "that WVWZZZ1JZXW000001 is wvwzzz1jzxw000001, and an\nunderscore to a "
       "dash.",
       "  revisit vehicle create shuttle-7\n"
       "  revisit vehicle create wvwzzz1jzxw000001 --display-name 'Golf 3' "
       "--label site=north\n"
       "  revisit vehicle create drone-1 --state-space spatial "
       "--node-spacing 0.5"});
  const auto id = std::make_shared<std::string>();
  const auto settings = std::make_shared<v1::VehicleSettings>();
  const auto description = std::make_shared<VehicleDescription>();
  AddId(command, id.get(), "Lower-case letters, digits, dashes");
  AddDescription(command, description.get());
  AddVehicleSettings(command, settings.get());
  const Run run = [=](const Connection& server, const Terminal& terminal) {
    return RunVehicleCreate(server.client, *id, *settings, *description,
                            terminal);
  };
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(run, [description] { return CheckDescription(*description); });
}

void AddGet(const Command& vehicle) {
  const Command command =
      vehicle.AddCommand({"get", "Shows a vehicle.", "",
                          "  revisit vehicle get shuttle-7 --json"});
  const auto id = std::make_shared<std::string>();
  AddId(command, id.get());
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([id](const Connection& server, const Terminal& terminal) {
    return RunVehicleGet(server.client, *id, terminal);
  });
}

void AddList(const Command& vehicle) {
  const Command command = vehicle.AddCommand(
      {"list", "Lists all vehicles.",
       "-o wide shows labels, settings that are not what the help of create "
       "states, and findings too.",
       "  revisit vehicle list\n"
       "  revisit vehicle list -o wide\n"
       "  revisit vehicle list -o name"});
  command.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  command.Runs([](const Connection& server, const Terminal& terminal) {
    return RunVehicleList(server.client, terminal);
  });
}

void AddUpdate(const Command& vehicle) {
  const Command command = vehicle.AddCommand(
      {"update", "Changes what is given, and nothing else.",
       "Once a vehicle has poses, its state space and its frame are fixed, and "
       "so is\nwhether its correlation model is filter.",
       "  revisit vehicle update shuttle-7 --no-use-belief --apply-inflation\n"
       "  revisit vehicle update shuttle-7 --acceptance-probability 0.9\n"
       "  revisit vehicle update shuttle-7 --max-passes 4 --max-age 31536000"});
  const auto id = std::make_shared<std::string>();
  const auto changes = std::make_shared<v1::VehicleSettings>();
  const auto description = std::make_shared<VehicleDescription>();
  AddId(command, id.get());
  AddDescription(command, description.get());
  AddRemovedLabels(command, description.get());
  AddVehicleSettings(command, changes.get());
  const Check check = [changes, description]() -> std::string {
    if (changes->ByteSizeLong() == 0 && IsEmpty(*description)) {
      return "A setting to change is required";
    }
    return CheckDescription(*description);
  };
  const Run run = [=](const Connection& server, const Terminal& terminal) {
    return RunVehicleUpdate(server.client, *id, *changes, *description,
                            terminal);
  };
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(run, check);
}

void AddAcceptLoss(const Command& vehicle) {
  const Command command = vehicle.AddCommand(
      {"accept-loss", "Lets a vehicle in the state DATA_LOSS take poses again.",
       "A client held an acknowledgement for poses that the store has not "
       "got. Whoever calls\nthis accepts that all after DURABLE_SEQ are "
       "gone; the client then sends them again, or\ngoes on from there. "
       "Restore a newer backup instead if there is one.",
       "  revisit vehicle get shuttle-7   # its state, its durable poses\n"
       "  revisit vehicle accept-loss shuttle-7 1200"});
  const auto id = std::make_shared<std::string>();
  const auto durable = std::make_shared<std::uint64_t>(0);
  AddId(command, id.get());
  command
      .AddWholeNumber("DURABLE_SEQ", WholeRange(), durable.get(),
                      "The vehicle's durable poses, to show that you know them")
      .Required();
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [id, durable](const Connection& server, const Terminal& terminal) {
        return RunVehicleAcceptLoss(server.client, *id, *durable, terminal);
      });
}

absl::StatusOr<std::string> ContentOfVehicle(const Client& client,
                                             const std::string& name) {
  v1::GetVehicleRequest request;
  request.set_name(name);
  const auto found = client.GetVehicle(request);
  if (!found.ok()) return found.status();
  const v1::Vehicle& vehicle = found->vehicle();
  return absl::StrCat(" with its ", vehicle.durable_sequence(), " poses and ",
                      vehicle.loop_closure_count(), " loop closures");
}

absl::Status RemoveVehicle(const Client& client, const std::string& name,
                           std::uint64_t) {
  v1::DeleteVehicleRequest request;
  request.set_name(name);
  return client.DeleteVehicle(request).status();
}

constexpr DeletedKind kVehicles = {&VehicleName, &ContentOfVehicle,
                                   &RemoveVehicle};

// A map of protobuf has no order of its own.
std::map<std::string, std::string> SortedLabels(const v1::Vehicle& vehicle) {
  return {vehicle.labels().begin(), vehicle.labels().end()};
}

void AddLabels(const v1::Vehicle& vehicle, Fields* fields) {
  for (const auto& [key, value] : SortedLabels(vehicle)) {
    fields->emplace_back(absl::StrCat("label ", key), value);
  }
}

// The cells that only -o wide shows, in the order of WideColumns().
std::vector<std::string> WideCells(const v1::Vehicle& vehicle) {
  std::vector<std::string> labels;
  for (const auto& [key, value] : SortedLabels(vehicle)) {
    labels.push_back(absl::StrCat(key, "=", value));
  }
  std::vector<std::string> findings;
  for (const v1::Finding& finding : vehicle.findings()) {
    findings.push_back(NameOf(finding.code()));
  }
  return {absl::StrCat(vehicle.node_count()),
          Fixed(vehicle.travelled_meters(), 1),
          absl::StrCat(vehicle.dropped_pose_count()),
          vehicle.display_name(),
          absl::StrJoin(labels, ","),
          absl::StrJoin(UnusualSettings(vehicle.settings()), " "),
          absl::StrJoin(findings, ","),
          vehicle.uid()};
}

std::vector<Table::Column> WideColumns() {
  using Align = Table::Align;
  return {{"NODES", Align::kRight},   {"TRAVELLED m", Align::kRight},
          {"DROPPED", Align::kRight}, {"DISPLAY NAME", Align::kLeft},
          {"LABELS", Align::kLeft},   {"OTHER SETTINGS", Align::kLeft},
          {"FINDINGS", Align::kLeft}, {"UID", Align::kLeft}};
}

void PrintTable(const v1::ListVehiclesResponse& list,
                const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {
      {"VEHICLE", Align::kLeft},   {"STATE", Align::kLeft},
      {"POSES", Align::kRight},    {"REVISION", Align::kRight},
      {"CLOSURES", Align::kRight}, {"SPACE", Align::kLeft},
      {"MODEL", Align::kLeft},     {"CREATED", Align::kLeft}};
  if (terminal.wide()) {
    for (Table::Column& column : WideColumns()) {
      columns.push_back(std::move(column));
    }
  }
  Table table(std::move(columns));
  for (const v1::Vehicle& vehicle : list.vehicles()) {
    std::vector<std::string> row = {
        vehicle.name(),
        NameOf(vehicle.state()),
        absl::StrCat(vehicle.durable_sequence()),
        absl::StrCat(vehicle.revision()),
        absl::StrCat(vehicle.loop_closure_count()),
        NameOf(vehicle.settings().state_space()),
        NameOf(vehicle.settings().correlation_model()),
        CreateTime(vehicle)};
    if (terminal.wide()) {
      for (std::string& cell : WideCells(vehicle)) {
        row.push_back(std::move(cell));
      }
    }
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddVehicleCommand(const Command& program) {
  const Command vehicle = program.AddCommand(
      {"vehicle", "Creates, shows, changes and deletes vehicles.", "", ""});
  AddCreate(vehicle);
  AddGet(vehicle);
  AddList(vehicle);
  AddUpdate(vehicle);
  AddAcceptLoss(vehicle);
  AddDeletion(
      vehicle,
      {"delete", "Deletes vehicles with all their poses. Cannot be undone.",
       "At a terminal, the id of each vehicle has to be typed again; "
       "elsewhere, --yes is required.",
       "  revisit vehicle delete shuttle-7 shuttle-8 --yes"},
      kVehicles);
}

void PrintVehicle(const v1::Vehicle& vehicle, const Terminal& terminal) {
  const v1::VehicleSettings& settings = vehicle.settings();
  Fields fields = {
      {"name", vehicle.name()},
      {"uid", vehicle.uid()},
      {"state", NameOf(vehicle.state())},
      {"created", CreateTime(vehicle)},
      {"durable poses", absl::StrCat(vehicle.durable_sequence())},
      {"revision", absl::StrCat(vehicle.revision())},
      {"nodes", absl::StrCat(vehicle.node_count())},
      {"loop closures", absl::StrCat(vehicle.loop_closure_count())},
      {"travelled", absl::StrCat(Fixed(vehicle.travelled_meters(), 1), " m")}};
  if (vehicle.dropped_pose_count() > 0) {
    fields.emplace_back("dropped poses",
                        absl::StrCat(vehicle.dropped_pose_count(),
                                     ", the first that is kept is ",
                                     vehicle.first_kept_sequence()));
  }
  if (!vehicle.display_name().empty()) {
    fields.insert(fields.begin() + 1, {"display name", vehicle.display_name()});
  }
  AddLabels(vehicle, &fields);
  for (auto& setting : DescribeSettings(settings)) {
    fields.push_back(std::move(setting));
  }
  if (settings.checks() == v1::STORED_CHECKS_STORED) {
    std::string checked =
        absl::StrCat("up to pose ", vehicle.checked_sequence());
    if (vehicle.has_check_debt()) {
      absl::StrAppend(&checked, ", ", vehicle.check_debt(), " checks owed");
    }
    fields.emplace_back("checked", checked);
  }
  if (vehicle.has_consistency()) AddConsistency(vehicle.consistency(), &fields);
  for (const v1::Finding& finding : vehicle.findings()) {
    fields.emplace_back("finding", finding.message());
  }
  if (settings.has_geodetic_origin()) {
    fields.emplace_back("geodetic origin",
                        GeodeticText(settings.geodetic_origin()));
  }
  PrintFields(fields, terminal.out);
}

absl::Status RunVehicleCreate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& settings,
                              const VehicleDescription& description,
                              const Terminal& terminal) {
  v1::CreateVehicleRequest request;
  request.set_vehicle_id(id);
  *request.mutable_vehicle()->mutable_settings() = settings;
  Describe(description, request.mutable_vehicle());
  const auto response = client.CreateVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), terminal);
}

absl::Status RunVehicleGet(const Client& client, const std::string& id,
                           const Terminal& terminal) {
  v1::GetVehicleRequest request;
  request.set_name(VehicleName(id));
  const auto response = client.GetVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), terminal);
}

absl::Status RunVehicleUpdate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& changes,
                              const VehicleDescription& description,
                              const Terminal& terminal) {
  std::vector<const google::protobuf::FieldDescriptor*> changed;
  v1::VehicleSettings::GetReflection()->ListFields(changes, &changed);
  v1::UpdateVehicleRequest request;
  request.mutable_vehicle()->set_name(VehicleName(id));
  *request.mutable_vehicle()->mutable_settings() = changes;
  for (const auto* field : changed) {
    request.mutable_update_mask()->add_paths(
        absl::StrCat("settings.", field->name()));
  }
  Describe(description, &request);
  const auto response = client.UpdateVehicle(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), terminal);
}

absl::Status RunVehicleAcceptLoss(const Client& client, const std::string& id,
                                  std::uint64_t durable_sequence,
                                  const Terminal& terminal) {
  v1::AcceptDataLossRequest request;
  request.set_name(VehicleName(id));
  request.set_durable_sequence(durable_sequence);
  const auto response = client.AcceptDataLoss(request);
  if (!response.ok()) return response.status();
  return Print(response->vehicle(), terminal);
}

absl::Status RunVehicleList(const Client& client, const Terminal& terminal) {
  v1::ListVehiclesResponse all;
  v1::ListVehiclesRequest request;
  request.set_page_size(1000);
  const absl::Status listed = VisitPages(
      request,
      [&](const v1::ListVehiclesRequest& asked) {
        return client.ListVehicles(asked);
      },
      [](const v1::ListVehiclesResponse& page) -> const auto& {
        return page.vehicles();
      },
      [&](const v1::ListVehiclesResponse& page) -> absl::StatusOr<bool> {
        all.mutable_vehicles()->MergeFrom(page.vehicles());
        return true;
      });
  if (!listed.ok()) return listed;
  if (terminal.json()) {
    terminal.out << ToJson(all, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::Vehicle& vehicle : all.vehicles()) {
      terminal.out << Printable(vehicle.name()) << '\n';
    }
  } else {
    PrintTable(all, terminal);
  }
  return absl::OkStatus();
}

absl::Status RunVehicleDelete(const Client& client,
                              const std::vector<std::string>& ids,
                              const Ask& ask, const Terminal& terminal) {
  return RunDeletion(client, kVehicles, ids, ask, terminal);
}

}  // namespace revisit::client
