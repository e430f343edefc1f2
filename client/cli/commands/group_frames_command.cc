#include "client/cli/commands/group_frames_command.h"

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/frame_columns.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/trajectory/stored_groups.h"

namespace revisit::client {
namespace {

void PrintTable(const v1::ListFrameTransformsResponse& all,
                const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {{"RECORDING", Align::kLeft},
                                        {"LOOPS", Align::kRight}};
  AddFrameColumns(terminal.wide(), &columns);
  Table table(std::move(columns));
  for (const v1::FrameTransform& transform : all.frame_transforms()) {
    std::vector<std::string> cells = {
        transform.recording(), absl::StrCat(transform.loop_closure_count())};
    AddFrameCells(transform, terminal.wide(), &cells);
    table.AddRow(std::move(cells));
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddGroupFramesCommand(const Command& group) {
  const Command command = group.AddCommand(
      {"frames",
       "Tells where the recordings of a group's vehicles lie to each other.",
       absl::StrCat(
           "The table has all recordings of the members, with how many loop "
           "closures that agree tie each\ndirectly to the last one of --from, "
           "and how its frame is tied to that one's:\n"
           "  SAME         it is that one\n",
           kFrameStatesHelp,
           "Its x, y and yaw are those of its origin in the frame of that "
           "recording. -o wide has their\nstandard deviations too, and the "
           "place in its own frame at which they hold. Members of\nanother "
           "state space or correlation model are left out, and so are damaged "
           "ones."),
       "  revisit group frames depot --from shuttle-7\n"
       "  revisit group frames depot --from shuttle-7 --in shuttle-8 -o wide"});
  const auto request = std::make_shared<v1::ListFrameTransformsRequest>();
  AddGroupName(command, request->mutable_parent());
  command
      .AddText("--from", "VEHICLE", request->mutable_vehicle(),
               "The member in whose last recording's frame the others are told")
      .Required();
  AddMembers(command, "Only recordings of these members",
             [request](const std::string& vehicle) {
               request->add_vehicles(vehicle);
             });
  command.AddSwitch(
      "--partial", [request](bool allow) { request->set_allow_partial(allow); },
      "Do not wait until the server has read all histories: answer with those "
      "that it has");
  command.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  command.Runs([request](const Connection& server, const Terminal& terminal) {
    return RunGroupFrames(server.client, *request, terminal);
  });
}

absl::Status RunGroupFrames(const Client& client,
                            v1::ListFrameTransformsRequest request,
                            const Terminal& terminal) {
  request.set_parent(GroupName(request.parent()));
  request.set_vehicle(VehicleName(request.vehicle()));
  const auto all = ReadFrameTransforms(client, request);
  if (!all.ok()) return WithPartialHint(all.status());
  if (terminal.json()) {
    terminal.out << ToJson(*all, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::FrameTransform& transform : all->frame_transforms()) {
      terminal.out << Printable(transform.recording()) << '\n';
    }
  } else {
    PrintTable(*all, terminal);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
